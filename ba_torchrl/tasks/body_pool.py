"""Pool: bodies that are loaded once, some of them in the scene, the others out of the way."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.shapes import Shape
from ba_torchrl.sim.world import World

ASIDE_Z_M = 1e6
ASIDE_SPACING_M = 0.3
ASIDE_X_M = 5.0
COLUMNS = 10


class BodyPool:
    """The bodies of a task that brings some of them only, or not all at once.

    Those put aside fall freely, each in its own column, for seven simulated minutes at least.
    That costs less than anything that rests, and nothing about a body ever changes but its pose:
    changed masses or collision filters would give it a new place in PyBullet's lists, and a
    restored state another future.

    Args:
        world: not sealed yet.
        shapes: of the bodies.
        names: of the bodies.
    """

    def __init__(self, world: World, shapes: Sequence[Shape], names: Sequence[str]) -> None:
        self.bodies = [world.add(shape, n) for shape, n in zip(shapes, names, strict=True)]
        """All of them."""
        self.present: list[Body] = []
        """Those in the scene, in the order in which they came."""
        self.clear()

    def clear(self) -> None:
        """Put all bodies aside."""
        self.present = []
        for i, body in enumerate(self.bodies):
            move_out_of_scene(body, i)

    def activate(self, body: Body) -> None:
        """Take a body into the scene; the caller gives it its pose."""
        body.is_hidden = False
        self.present.append(body)

    def deactivate(self, body: Body) -> None:
        """Take a body out of the scene."""
        self.present.remove(body)
        move_out_of_scene(body, self.bodies.index(body))

    def get_state(self) -> tuple[int, ...]:
        """Return which bodies are in the scene."""
        return tuple(self.bodies.index(body) for body in self.present)

    def set_state(self, state: tuple[int, ...]) -> None:
        """Take up what `get_state` returned; poses and visibility are the scene's to restore."""
        self.present = [self.bodies[i] for i in state]


def move_out_of_scene(body: Body, place: int) -> None:
    """Put a body out of the way; see `BodyPool`.

    Args:
        body: gets hidden, too.
        place: number of its column, of which each body has its own.
    """
    row, column = divmod(place, COLUMNS)
    body.place((ASIDE_X_M + ASIDE_SPACING_M * column, ASIDE_SPACING_M * row, ASIDE_Z_M))
    body.is_hidden = True
