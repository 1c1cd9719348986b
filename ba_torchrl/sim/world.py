"""World: one PyBullet client with its bodies, stepping, settling and exact resets."""

from __future__ import annotations

import os
import sys
import tempfile
import weakref
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import pybullet
import pybullet_data

from ba_torchrl.errors import SimulationError
from ba_torchrl.sim.articulated import Articulated, ArticulatedLink, Rail
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.shapes import Color, Shape


@dataclass(frozen=True)
class Physics:
    """Settings of the physics engine.

    The defaults are those of close-loop control: with a finger force of 2 and bounded
    accelerations, 120 Hz with 50 solver iterations holds an object as firmly as 240 Hz.
    """

    time_step_s: float = 1 / 120
    solver_iterations: int = 50
    solver_residual: float = 0.0
    """Residual at which a step's iterations stop early. Above zero, they stop by what the motors
    remember of earlier steps, which no saved state holds: restored states lose their exactness."""
    gravity_m_s2: float = 10.0
    floor_friction: float = 0.5  # at 1.0 a pushed cube tips over its leading edge and wedges
    settle_speed_m_s: float = 0.01
    settle_spin_rad_s: float = 0.2


FINE_PHYSICS = Physics(time_step_s=1 / 240, solver_iterations=200)
"""Four times the work of the default."""


class Snapshot:
    """A state that PyBullet keeps in memory for as long as this object lives."""

    def __init__(self, client: int, connection: weakref.finalize) -> None:
        self.client = client
        self.connection = connection
        self.id = pybullet.saveState(physicsClientId=client)
        weakref.finalize(self, _forget, self.id, client, connection)


@dataclass(frozen=True)
class SavedState:
    """A state that outlives its world: any other with the same bodies can take it up."""

    data: bytes = field(repr=False)


class World:
    """A physics client of its own with a floor, whose bodies are loaded once.

    After everything is loaded, `seal` takes the pristine state; `restore_pristine` returns to it
    exactly, so that the same poses and actions give the same future bit by bit. Several worlds
    live side by side in one process.

    Args:
        physics: settings of the engine.
        window: show the simulation in PyBullet's window; a process can have one.
        floor_color: red, green, blue, alpha of the floor; None is PyBullet's chequered blue.

    Raises:
        SimulationError: there is no display for the window, it is in use, or PyBullet offers no
            further client (it allows 1024).
    """

    def __init__(
        self,
        physics: Physics | None = None,
        *,
        window: bool = False,
        floor_color: Color | None = None,
    ) -> None:
        self.physics = physics or Physics()
        self.client = _connect_window() if window else pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise SimulationError("PyBullet has no free client: close environments not in use")
        self._disconnect = weakref.finalize(self, _disconnect, self.client)
        self.bodies: list[Body] = []
        self.steps = 0
        """Physics steps since construction, for measurements."""
        self._pristine: Snapshot | None = None
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.physics.time_step_s,
            numSolverIterations=self.physics.solver_iterations,
            solverResidualThreshold=self.physics.solver_residual,
            numSubSteps=0,
            # contact pairs in a fixed order: without it, identical episodes differ in the last bit
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        pybullet.setGravity(0, 0, -self.physics.gravity_m_s2, physicsClientId=self.client)
        self.floor = pybullet.loadURDF(
            f"{pybullet_data.getDataPath()}/plane.urdf", physicsClientId=self.client
        )
        pybullet.changeDynamics(
            self.floor,
            -1,
            lateralFriction=self.physics.floor_friction,
            physicsClientId=self.client,
        )
        if floor_color is not None:
            pybullet.changeVisualShape(
                self.floor,
                -1,
                textureUniqueId=-1,
                rgbaColor=floor_color,
                physicsClientId=self.client,
            )

    def add(self, shape: Shape, name: str) -> Body:
        """Load a body; only before `seal`.

        Raises:
            SimulationError: the world is sealed.
        """
        self._check_open(name)
        body = Body(self.client, shape, name)
        self.bodies.append(body)
        return body

    def add_articulated(self, base: Shape, slider: Shape, rail: Rail, name: str) -> Articulated:
        """Load a fixed body with a part that slides; both enter `bodies`. Only before `seal`.

        Raises:
            SimulationError: the world is sealed.
        """
        self._check_open(name)
        body = Articulated(self.client, base, slider, rail, name)
        self.bodies.extend(body.parts)
        return body

    def seal(self) -> None:
        """Take the state that every reset starts from."""
        self._pristine = self.snapshot()

    def restore_pristine(self) -> None:
        """Return to the state taken by `seal`, velocities and contacts included."""
        if self._pristine is None:
            raise SimulationError("seal() the world before resetting it")
        self.restore(self._pristine)

    def snapshot(self) -> Snapshot:
        """Keep the state of every body and contact in memory, for `restore`.

        The world goes on from it as it will after each `restore`: what the engine remembers beyond
        what it saves is given up here and there.
        """
        snapshot = Snapshot(self.client, self._disconnect)
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a snapshot of this world; motor commands are the caller's to repeat.

        Raises:
            SimulationError: the snapshot is of another world, or of one that was closed.
        """
        # client numbers are used again, connections are not
        if snapshot.connection is not self._disconnect or self.is_closed:
            raise SimulationError("the state is of another world: that one was closed or rebuilt")
        # once for the places, where the engine then looks afresh, and once for all else
        pybullet.restoreState(snapshot.id, physicsClientId=self.client)
        self._forget_pairs()
        pybullet.restoreState(snapshot.id, physicsClientId=self.client)

    def save(self) -> SavedState:
        """Return the state of every body and contact, for `load` in a world built alike."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "state.bullet"
            pybullet.saveBullet(str(path), physicsClientId=self.client)
            return SavedState(path.read_bytes())

    def load(self, state: SavedState) -> None:
        """Take up a state; motor commands are the caller's to repeat.

        Raises:
            SimulationError: its world had other bodies.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "state.bullet"
            path.write_bytes(state.data)
            try:
                pybullet.restoreState(fileName=str(path), physicsClientId=self.client)
            except pybullet.error as error:
                raise SimulationError(f"the state is of another world ({error})") from None

    def step(self, count: int = 1) -> None:
        """Advance the physics by ``count`` time steps."""
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=self.client)
        self.steps += count

    def detect_collisions(self) -> None:
        """Bring the contact points up to date without advancing time."""
        pybullet.performCollisionDetection(physicsClientId=self.client)

    def is_still(self) -> bool:
        """Whether no movable body moves faster than the settling limits."""
        return all(
            body.is_static
            or body.is_hidden
            or body.is_still(self.physics.settle_speed_m_s, self.physics.settle_spin_rad_s)
            for body in self.bodies
        )

    def settle(self, max_steps: int = 200) -> bool:
        """Step until the bodies are still on two steps in a row, at most ``max_steps``.

        Returns:
            Whether they came to rest.
        """
        still = 0
        for _ in range(max_steps):
            self.step()
            still = still + 1 if self.is_still() else 0
            if still == 2:
                return True
        return False

    def close(self) -> None:
        """Disconnect the client; further calls do nothing."""
        self._disconnect()

    @property
    def is_closed(self) -> bool:
        """Whether the client is gone."""
        return not self._disconnect.alive

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _forget_pairs(self) -> None:
        """Let the engine look afresh at what is near each other.

        It keeps its last guess at how two convex hulls, such as a finger and a block, are apart,
        which no saved state holds; from another guess the same scene goes on differently. It also
        goes through its list of pairs a few at a time, to drop those that are apart by now, and
        starts again at the first one only once the list was empty.
        """
        pybullet.setCollisionFilterGroupMask(self.floor, -1, 0, 0, physicsClientId=self.client)
        for body in self.bodies:
            for link in body.links if isinstance(body, ArticulatedLink) else (-1,):
                pybullet.setCollisionFilterGroupMask(
                    body.id, link, 0, 0, physicsClientId=self.client
                )
        self.detect_collisions()
        _renew_pairs(self.client, self.floor, is_static=True)
        for body in self.bodies:
            if isinstance(body, ArticulatedLink):
                body.forget_pairs()
            else:
                _renew_pairs(self.client, body.id, body.is_static)

    def _check_open(self, name: str) -> None:
        if self._pristine is not None:
            raise SimulationError(f"cannot add {name!r}: the world is sealed")


def _renew_pairs(client: int, body: int, is_static: bool) -> None:
    # PyBullet's own groups: what is static meets all but its like
    group, mask = (2, ~2) if is_static else (1, -1)
    pybullet.setCollisionFilterGroupMask(body, -1, group, mask, physicsClientId=client)


def _connect_window() -> int:
    """Open PyBullet's window and return its client."""
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        # PyBullet would end the process
        raise SimulationError(
            "render=True opens a window, and there is no display (DISPLAY is not set): use "
            "env.render() for pictures, or start under a virtual display such as xvfb-run"
        )
    try:
        client = pybullet.connect(pybullet.GUI, options="--width=960 --height=720")
    except pybullet.error as error:
        raise SimulationError(
            f"PyBullet cannot open a window ({error}): a process can have one at a time"
        ) from None
    if client >= 0:
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client


def _forget(state: int, client: int, connection: weakref.finalize) -> None:
    if connection.alive:  # else the client's number may be another world's by now
        pybullet.removeState(state, physicsClientId=client)


def _disconnect(client: int) -> None:
    if pybullet.isConnected(physicsClientId=client):
        pybullet.disconnect(physicsClientId=client)
