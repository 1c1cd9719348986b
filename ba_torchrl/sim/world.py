"""World: a PyBullet client with its bodies; stepping, settling and exact resets."""

from __future__ import annotations

import contextlib
import ctypes
import locale
import os
import sys
import tempfile
import threading
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Protocol

import pybullet
import pybullet_data
from typing_extensions import Self

from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim.articulated import ArticulatedBody, PrismaticJoint
from ba_torchrl.sim.bodies import Body, set_asleep
from ba_torchrl.sim.shapes import Color, Shape


class Snapshot:
    """A saved state, which any world with the same bodies can load, also in another process.

    It is in bytes and, to restore the world that it is of in less time, in PyBullet's memory, which
    is freed when this object is deleted. The connection is the finalizer of that world.
    """

    connection: weakref.finalize | None = None

    def __init__(self, client: int, connection: weakref.finalize) -> None:
        with _temporary_file() as path:
            pybullet.saveBullet(path, physicsClientId=client)
            self.content = Path(path).read_bytes()
        self.connection = connection
        self.id = pybullet.saveState(physicsClientId=client)
        weakref.finalize(self, _remove_state, self.id, client, connection)

    def load(self, client: int, connection: weakref.finalize) -> None:
        """Load the state into a client, whose world has this connection."""
        if connection is self.connection:  # PyBullet reuses client ids
            pybullet.restoreState(self.id, physicsClientId=client)
            return
        with _temporary_file() as path:
            Path(path).write_bytes(self.content)
            pybullet.restoreState(fileName=path, physicsClientId=client)

    def __getstate__(self) -> dict[str, bytes]:
        return {"content": self.content}


@contextlib.contextmanager
def _temporary_file() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="ba_torchrl-") as folder:
        yield f"{folder}/world.bullet"


def _remove_state(state: int, client: int, connection: weakref.finalize) -> None:
    # otherwise the client id may already belong to another world, or the window is closed
    if connection.alive and pybullet.isConnected(physicsClientId=client):
        pybullet.removeState(state, physicsClientId=client)


MAX_CLIENTS = 1024
"""Number of worlds that a process can have, a limit of PyBullet."""

SIMULATOR_ERRORS = (pybullet.error, SimulationError)
"""Errors of PyBullet, among them a lost connection, and values from it that are not finite."""


@dataclass(frozen=True)
class Physics:
    """Settings of the physics engine.

    The defaults are for close-loop control. With a finger force of 2 and bounded
    accelerations, grasps at 120 Hz with 50 solver iterations are as stable as at 240 Hz.
    """

    time_step_s: float = 1 / 120
    solver_iterations: int = 50
    solver_residual: float = 0.0
    """Residual below which the solver stops early; 0 for always `solver_iterations`."""
    gravity_m_s2: float = 10.0
    floor_friction: float = 0.5  # at 1.0 a pushed cube tips over its leading edge and jams
    settle_speed_m_s: float = 0.01
    """Largest speed of a body at rest."""
    settle_spin_rad_s: float = 0.2
    """Largest angular speed of a body at rest."""


FINE_PHYSICS = Physics(time_step_s=1 / 240, solver_iterations=200)
"""Half the time step and four times the solver iterations of the default."""


class Sleeper(Protocol):
    """A mechanism that need not be simulated while it is at rest, such as a robot."""

    def is_possible(self) -> bool:
        """Whether it is at rest and touches nothing."""

    def set_asleep(self, is_asleep: bool) -> None:
        """Set whether it is simulated, from the end of the next step on."""


class World:
    """A PyBullet client with a floor and bodies that are loaded once.

    `seal` saves the state after all bodies are loaded and `restore_pristine` restores it exactly:
    the same poses and actions then give the same trajectory bit by bit. A process can have several
    worlds.

    Args:
        window: show the simulation in PyBullet's window; a process can have one.
        floor_color: red, green, blue, alpha of the floor; None keeps PyBullet's blue chequered
            texture.

    Raises:
        SimulationError: there is no display for the window, the process already has a window, or
            PyBullet has no free client (the maximum is 1024).
    """

    def __init__(
        self,
        physics: Physics | None = None,
        *,
        window: bool = False,
        floor_color: Color | None = None,
    ) -> None:
        self.physics = physics or Physics()
        self.client = connect_window() if window else pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise SimulationError("PyBullet has no free client: close environments not in use")
        self._disconnect = weakref.finalize(self, _disconnect, self.client)
        # The simple broadphase compares the bounding boxes of all bodies. The order of pairs in
        # Bullet's search tree depends on all earlier motion, which no saved state contains, and
        # where many bodies touch, this order affects their motion.
        pybullet.resetSimulation(pybullet.RESET_USE_SIMPLE_BROADPHASE, physicsClientId=self.client)
        self.bodies: list[Body] = []
        self.moving_bodies: list[Body] = []
        """The bodies that are not static."""
        self.sleepers: list[Sleeper] = []
        """Mechanisms that `settle` does not simulate while they are at rest."""
        self._wakes_late = False
        """Whether they may not be simulated in the next step, since `settle` was interrupted."""
        self._moved_last: Body | None = None
        self._has_fixed_poses = False
        self.steps = 0
        """Number of physics steps since construction."""
        self._pristine: Snapshot | None = None
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.physics.time_step_s,
            numSolverIterations=self.physics.solver_iterations,
            solverResidualThreshold=self.physics.solver_residual,
            numSubSteps=0,
            # a fixed order of contact pairs: without it, identical episodes differ in the last bit
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        pybullet.setGravity(0, 0, -self.physics.gravity_m_s2, physicsClientId=self.client)
        model = f"{pybullet_data.getDataPath()}/plane.urdf"
        with loading(model), decimal_point(self.client):
            self.floor = pybullet.loadURDF(model, physicsClientId=self.client)
        pybullet.changeDynamics(
            self.floor, -1, lateralFriction=self.physics.floor_friction, physicsClientId=self.client
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
        """Load a body; possible only before `seal`."""
        self._check_not_sealed(name)
        with decimal_point(self.client):
            body = Body(self.client, shape, name)
        self._register(body)
        return body

    def add_articulated(
        self, base: Shape, slider: Shape, joint: PrismaticJoint, name: str
    ) -> ArticulatedBody:
        """Load a fixed body with a sliding part; possible only before `seal`.

        Both links are added to `bodies`.
        """
        self._check_not_sealed(name)
        with decimal_point(self.client):
            body = ArticulatedBody(self.client, base, slider, joint, name)
        self._register(*body.parts)
        return body

    def seal(self) -> None:
        """Save the current state as the one that every reset starts from."""
        self._pristine = self.snapshot()

    def restore_pristine(self) -> None:
        """Restore the state saved by `seal`, including velocities and contacts."""
        if self._pristine is None:
            raise SimulationError("seal() the world before resetting it")
        self.restore(self._pristine)

    def snapshot(self) -> Snapshot:
        """Save the state of every body and contact, for `restore`.

        The snapshot is also restored at once, which clears the internal caches of the engine that
        no snapshot contains. The trajectory from here therefore equals that after each `restore`.
        """
        snapshot = Snapshot(self.client, self._disconnect)
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot; the caller must repeat the motor commands.

        Args:
            snapshot: of this world, or of another with the same bodies.
        """
        self._check_not_fixed()
        if self.is_closed:
            raise SimulationError("the world is closed")
        self._wake_all()
        # the first call restores the poses at which the pairs are rebuilt, the second all the rest
        snapshot.load(self.client, self._disconnect)
        self._rebuild_collision_pairs()
        snapshot.load(self.client, self._disconnect)
        for body in self.bodies:
            body.apply_activity()

    def step(self, count: int = 1) -> None:
        """Advance the physics by ``count`` time steps."""
        self._check_not_fixed()
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=self.client)
        self.steps += count

    def detect_collisions(self) -> None:
        """Update the contact points without advancing time."""
        pybullet.performCollisionDetection(physicsClientId=self.client)

    @contextlib.contextmanager
    def fixed_poses(self) -> Iterator[None]:
        """A context in which no body moves, so that the pose of each is read once.

        Experts act in it. Steps, restored states and teleported bodies raise a `RuntimeError`.
        """
        self._check_not_fixed()
        self._has_fixed_poses = True
        try:
            for body in self.bodies:
                if not body.is_inactive:
                    body.fix_pose(True)
            yield
        finally:
            self._has_fixed_poses = False
            for body in self.bodies:
                body.fix_pose(False)

    def is_still(self, except_for: Body | None = None) -> bool:
        """Whether no visible body exceeds the speeds of a body at rest."""
        # the body that moved at the last call is probably the one that still moves
        last = self._moved_last
        if last is not None and last is not except_for and self._moves(last):
            return False
        others = (body for body in self.moving_bodies if body is not except_for)
        self._moved_last = next(filter(self._moves, others), None)
        return self._moved_last is None

    def settle(self, max_steps: int = 200) -> bool:
        """Step until `is_still` holds in two consecutive steps; return whether it does."""
        sleepers = [sleeper for sleeper in self.sleepers if sleeper.is_possible()]
        still, are_asleep = 0, False
        try:
            for number in range(1, max_steps + 1):
                may_be_last = still == 1 or number == max_steps
                if are_asleep == may_be_last:  # they are awake at the end of the last step
                    are_asleep = not may_be_last
                    _set_asleep(sleepers, are_asleep)
                self.step()
                still = still + 1 if self.is_still() else 0
                if still == 2:
                    return True
            return False
        except BaseException:
            self._wakes_late = True
            with contextlib.suppress(pybullet.error):  # without a connection: raise the first error
                _set_asleep(sleepers, False)
            raise

    def close(self) -> None:
        """Disconnect the client; repeated calls have no effect."""
        self._disconnect()

    @property
    def is_closed(self) -> bool:
        """Whether the client is disconnected."""
        return not self._disconnect.alive

    def __reduce__(self) -> NoReturn:
        raise TypeError("a world cannot be copied: copy the environment, or use its get_state")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wake_all(self) -> None:
        """Take a step after which all are awake: no saved state contains which of them sleep."""
        sleepers = [body for body in self.bodies if body.has_slept and not body.is_static]
        for body in sleepers:
            set_asleep(self.client, body.id, False)
        if self._wakes_late:
            _set_asleep(self.sleepers, False)
        if sleepers or self._wakes_late:
            pybullet.stepSimulation(physicsClientId=self.client)
        self._wakes_late = False

    def _rebuild_collision_pairs(self) -> None:
        """Remove all collision pairs from the engine and detect them again.

        No saved state contains two properties of the engine that affect the trajectory: the last
        separating direction of each pair of convex hulls, such as a finger and a block, and the
        order in which pairs came close. Removing all pairs resets both.
        """
        links = [(self.floor, -1, True)]
        links += [(body.id, link, body.is_static) for body in self.bodies for link in body.links]
        for body_id, link, _ in links:
            pybullet.setCollisionFilterGroupMask(body_id, link, 0, 0, physicsClientId=self.client)
        self.detect_collisions()
        for body_id, link, is_static in links:
            # PyBullet's default collision groups: static bodies do not collide with each other
            group, mask = (2, ~2) if is_static else (1, -1)
            pybullet.setCollisionFilterGroupMask(
                body_id, link, group, mask, physicsClientId=self.client
            )

    def _moves(self, body: Body) -> bool:
        """Whether a body is visible and exceeds the speeds of a body at rest."""
        limits = self.physics.settle_speed_m_s, self.physics.settle_spin_rad_s
        return not (body.is_hidden or body.is_still(*limits))

    def _register(self, *bodies: Body) -> None:
        """Add loaded bodies to the lists of bodies."""
        self.bodies.extend(bodies)
        self.moving_bodies.extend(body for body in bodies if not body.is_static)

    def _check_not_fixed(self) -> None:
        if self._has_fixed_poses:  # no fault of the simulator, which would be counted
            raise RuntimeError("bodies cannot move here, for example in an expert: poses are fixed")

    def _check_not_sealed(self, name: str) -> None:
        if self._pristine is not None:
            raise SimulationError(f"cannot add {name!r}: the world is sealed")


def _set_asleep(sleepers: Iterable[Sleeper], are_asleep: bool) -> None:
    for sleeper in sleepers:
        sleeper.set_asleep(are_asleep)


def count_clients() -> int:
    """Return the number of open connections to PyBullet in this process."""
    return sum(map(pybullet.isConnected, range(MAX_CLIENTS)))


def _disconnect(client: int) -> None:
    if pybullet.isConnected(physicsClientId=client):
        pybullet.disconnect(physicsClientId=client)


@contextlib.contextmanager
def loading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Replace PyBullet's error, which gives no reason, by an error with the reason.

    Raises:
        OSError: the file cannot be opened: it is missing, or too many files are open.
        SimulationError: it can be opened, but PyBullet does not load it.
    """
    try:
        yield
    except pybullet.error as error:
        with open(path, "rb"):
            raise SimulationError(f"PyBullet cannot load {path}: {error}") from error


_process_locale = threading.RLock()
"""Held while the locale of the process is changed."""


@contextlib.contextmanager
def decimal_point(client: int) -> Iterator[None]:
    """A context in which PyBullet reads numbers in files with a decimal point.

    Every robot, body and floor is loaded in it. PyBullet reads numbers as the locale says, which a
    user, or a toolkit such as Qt, may have set to one with a decimal comma.

    Without a window, PyBullet loads files in the calling thread, and only this thread's locale
    changes. A window loads files in a thread of its own, so that the locale of the process changes,
    as it does on systems where a thread has no locale.
    """
    libc = ctypes.CDLL(None)
    has_window = pybullet.getConnectionInfo(client)["connectionMethod"] != pybullet.DIRECT
    if has_window or not hasattr(libc, "uselocale"):
        with _process_locale:
            before = locale.setlocale(locale.LC_NUMERIC)
            locale.setlocale(locale.LC_NUMERIC, "C")
            try:
                yield
            finally:
                locale.setlocale(locale.LC_NUMERIC, before)
        return
    for function in (libc.uselocale, libc.duplocale, libc.newlocale):
        function.restype = ctypes.c_void_p
    before = ctypes.c_void_p(libc.uselocale(None))
    # of numbers alone, as a robot's code may read texts in the encoding of the locale
    base = ctypes.c_void_p(libc.duplocale(before))
    own = ctypes.c_void_p(libc.newlocale(1 << locale.LC_NUMERIC, b"C", base))
    libc.uselocale(own)
    try:
        yield
    finally:
        libc.uselocale(before)
        libc.freelocale(own)


def connect_window() -> int:
    """Open PyBullet's window and return its client."""
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise SimulationError(
            "render=True opens a window, but DISPLAY is not set: use env.render() for images, or "
            "run under a virtual display such as xvfb-run"
        )
    try:
        client = pybullet.connect(pybullet.GUI, options="--width=960 --height=720")
    except pybullet.error as error:
        raise SimulationError(
            f"PyBullet cannot open a window ({error}): a process can have only one"
        ) from None
    if client >= 0:
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client
