"""A terrain: a level plateau above the floor, and a stack that is built on it."""

from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, tower
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.pieces import cube
from ba_torchrl.tasks.terrain.flat import Terrain

HEIGHT_M = 0.03


class Plateau(Terrain):
    """A static slab that covers the workspace."""

    def __init__(self, world, workspace):
        super().__init__(world, workspace)
        slab = Box(size_m=(0.5, 0.5, HEIGHT_M), mass_kg=0.0, friction=0.5)
        self.slab = world.add(slab, "plateau")
        self.slab.place((*workspace.center, HEIGHT_M / 2))

    @property
    def support_ids(self):
        """The slab."""
        return frozenset((self.slab.id,))

    def height_m(self, xy):
        """Return the height of the slab's top."""
        return HEIGHT_M


@TASKS.register("mine/stack_on_plateau")
class StackOnPlateau(StructureTask):
    """Three cubes on the plateau; success when they stand in a stack."""

    num_objects = 3
    num_objects_range = (2, 4)

    def make_terrain(self):
        """Load the plateau."""
        return Plateau(self.world, self.settings.workspace)

    def blueprint(self) -> Blueprint:
        """Return the stack."""
        return tower(*[cube(self.block_m)] * self.settings.num_objects)
