"""Random parts of an episode: a plateau of random height, and blocks of random colours."""

from dataclasses import replace

from mine.plateau import Plateau, StackOnPlateau

from ba_torchrl.tasks.base import BLUE, GREEN, ORANGE, RED, TASKS
from ba_torchrl.tasks.close_loop.block_stacking import BlockStacking
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.pieces import cube


class RandomPlateau(Plateau):
    """A plateau that is sunk into the floor to a random height."""

    sunk_m = 0.0

    def initialize_episode(self, rng):
        """Draw the height."""
        self.sunk_m = rng.uniform(0.0, 0.02)
        x, y = self.workspace.center
        self.slab.place((x, y, super().height_m((x, y)) / 2 - self.sunk_m))

    def get_state(self):
        """Return by how much the slab is sunk."""
        return self.sunk_m

    def set_state(self, state):
        """Restore the height."""
        self.sunk_m = state

    def height_m(self, xy):
        """Return the height of the slab's top."""
        return super().height_m(xy) - self.sunk_m


@TASKS.register("mine/stack_on_random_plateau")
class StackOnRandomPlateau(StackOnPlateau):
    """Three cubes on a plateau of random height; success when they stand in a stack."""

    def make_terrain(self):
        """Load the plateau."""
        return RandomPlateau(self.world, self.settings.workspace)


@TASKS.register("mine/stack_of_any_colour")
class StackOfAnyColour(BlockStacking):
    """Cubes of different random colours; success when they stand in a stack."""

    num_objects_range = (2, 5)
    max_steps = 100

    def blueprint(self) -> Blueprint:
        """Return a stack of cubes with a variant for each colour."""
        colours = (RED, BLUE, GREEN, ORANGE, (0.5, 0.2, 0.6, 1.0), (0.9, 0.9, 0.3, 1.0))
        variants = tuple(cube(self.block_m, colour) for colour in colours)
        piece = replace(variants[0], shape=None, variants=variants)
        return tower(*[piece] * self.settings.num_objects)
