"""A pool of bodies that are loaded once; every episode uses some of them."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.shapes import Shape
from ba_torchrl.sim.world import World

INACTIVE_Z_M = 1e6
"""Height of inactive bodies, which fall for a step before they sleep."""
INACTIVE_X_M = 5.0
"""Least x of inactive bodies, outside every workspace; of static ones, least -x."""
INACTIVE_SPACING_M = 0.3
"""Distance between inactive bodies."""
COLUMNS = 10
"""Inactive bodies per row."""


class BodyPool:
    """Bodies, only some of which are in the scene at a time.

    Inactive bodies are hidden and at a great height, in Bullet's sleeping state, in which they are
    not simulated. Their masses and collision filters are as before: a change would change the order
    of PyBullet's internal lists, so that the simulation from a restored state would differ.

    Args:
        world: not sealed yet.
    """

    def __init__(self, world: World, shapes: Sequence[Shape], names: Sequence[str]) -> None:
        self.bodies = [world.add(shape, n) for shape, n in zip(shapes, names, strict=True)]
        """All bodies."""
        self.active: list[Body] = []
        """The bodies in the scene, in the order of their activation."""
        self.clear()

    def clear(self) -> None:
        """Deactivate all bodies."""
        self.active = []
        for i, body in enumerate(self.bodies):
            deactivate_body(body, i)

    def activate(self, body: Body) -> None:
        """Add a body to the scene; the caller sets its pose."""
        body.set_inactive(False)
        self.active.append(body)

    def deactivate(self, body: Body) -> None:
        """Remove a body from the scene."""
        self.active.remove(body)
        deactivate_body(body, self.bodies.index(body))

    def get_state(self) -> tuple[int, ...]:
        """Return the indices of the active bodies."""
        return tuple(self.bodies.index(body) for body in self.active)

    def set_state(self, state: tuple[int, ...]) -> None:
        """Set the active bodies by their indices; the world restores poses and visibility."""
        self.active = [self.bodies[i] for i in state]


def deactivate_body(body: Body, index: int) -> None:
    """Take a body out of the scene; see `BodyPool`.

    Args:
        index: number of its position, different for every inactive body.
    """
    row, column = divmod(index, COLUMNS)
    x_m, y_m = INACTIVE_X_M + INACTIVE_SPACING_M * column, INACTIVE_SPACING_M * row
    body.place((-x_m if body.is_static else x_m, y_m, INACTIVE_Z_M))
    body.set_inactive(True)
