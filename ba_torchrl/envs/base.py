"""ManipulationEnv: a task, a robot and a world as a TorchRL environment."""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ba_torchrl.config import EnvConfig
from ba_torchrl.envs import keys
from ba_torchrl.envs.images import ImageSpec
from ba_torchrl.envs.observations import ExtraObservations
from ba_torchrl.envs.scene import (
    Motion,
    Scene,
    SceneState,
    build_scene,
    check_action_limits,
    check_task_parameters,
)
from ba_torchrl.errors import ConfigError, InvalidActionError, PlacementError, SimulationError
from ba_torchrl.registry import Registry
from ba_torchrl.sim.robots.base import ROBOTS, Robot
from ba_torchrl.sim.vision.rgb import LIGHT_FLOOR, render_rgb
from ba_torchrl.sim.world import Physics
from ba_torchrl.tasks.base import SCALE_STEP, TASKS, ActionLimits, Task, Workspace

logger = logging.getLogger(__name__)

CONTROLS: Registry[type[ManipulationEnv]] = Registry("kind of control", "ba_torchrl.envs")

MAX_CONSECUTIVE_FAULTS = 10
RESET_ATTEMPTS = 50
SETTLE_STEPS = 100


@dataclass(frozen=True)
class EnvState:
    """Everything an environment's future follows from; see `ManipulationEnv.get_state`."""

    owner: object
    scale: float
    scene: SceneState
    observation: dict[str, torch.Tensor]
    memory: dict[str, Any]
    base_seed: int
    episode: int
    step_count: int
    ends: dict[str, bool]


class ManipulationEnv(EnvBase):
    """A manipulation task as an unbatched TorchRL environment on the CPU.

    Episodes follow from the seed alone: episode n of seed s is the same in any process, whatever
    happened before. Only tasks that go on with the objects of the last episode depend on it.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        config: the environment's parameters.

    Raises:
        ConfigError: the parameters do not fit the task or the robot.
    """

    def __init__(self, task_id: str, config: EnvConfig) -> None:
        super().__init__(device="cpu", batch_size=[])
        self.task_id = task_id
        self.config = config
        self.task_class = TASKS[task_id]
        check_task_parameters(task_id, config)
        self.robot_class = ROBOTS[config.robot]
        self.workspace = (
            self.task_class.workspace if config.workspace is None else Workspace(*config.workspace)
        )
        num_objects = config.num_objects or self.task_class.num_objects
        self.max_steps = config.max_steps or self.task_class.step_limit(num_objects)
        self.action_sequence = (
            self.default_action_sequence
            if config.action_sequence is None
            else config.action_sequence
        )
        """One letter per action component."""
        self.half_rotation = (
            self.default_half_rotation if config.half_rotation is None else config.half_rotation
        )
        self._configure()
        low, high = config.object_scale_range or self.task_class.scale_range
        self._scales = np.arange(low, high + 1e-9, SCALE_STEP)
        self._identity = object()
        self._scenes: dict[float, Scene] = {}
        self._scene: Scene | None = None
        self._observation: dict[str, torch.Tensor] = {}
        self._extras = ExtraObservations(config, self.workspace)
        self._memory: dict[str, Any] = {}
        """What an observation shows of earlier steps; replaced, never changed in place."""
        self._ends: dict[str, bool] = {}
        """How the last step ended, by key."""
        self._step_count = 0
        self._episode = 0
        self.faults = 0
        """Simulator faults since construction."""
        self._consecutive_faults = 0
        self.base_seed = 0
        self._set_seed(config.seed)
        self._make_specs()
        self._check_feasible()

    # -- for subclasses ----------------------------------------------------------------------

    physics: ClassVar[Physics] = Physics()
    """Settings of the physics engine in the mode "fast"."""
    camera_pose: ClassVar[tuple[float, float, float]] = (-0.06, 0.2, 1.05)
    """Of `render`: its middle along x from the workspace's, its height, and how far away it is."""
    default_action_sequence: ClassVar[str]
    """`action_sequence` unless it is given."""
    default_half_rotation: ClassVar[bool]
    """`half_rotation` unless it is given."""

    @abstractmethod
    def _configure(self) -> None:
        """Check the parameters that concern the control, and set up what it needs."""

    @abstractmethod
    def _make_motion(self, robot: Robot, task: Task) -> Motion:
        """Return what carries out actions."""

    @property
    @abstractmethod
    def action_limits(self) -> ActionLimits:
        """What one action covers."""

    @property
    @abstractmethod
    def _heights_to_reach(self) -> tuple[float, ...]:
        """Heights of the tool that the arm must reach above every corner of the workspace."""

    @abstractmethod
    def _make_action_spec(self) -> Bounded:
        """Return the specification of an action."""

    @abstractmethod
    def _declare_images(self) -> dict[str, ImageSpec]:
        """Return what `_images` gives, by key."""

    @abstractmethod
    def _place_robot(self, scene: Scene) -> None:
        """Put the robot into the pose an episode starts from."""

    @abstractmethod
    def _act(self, scene: Scene, action: np.ndarray) -> None:
        """Carry out an action."""

    @abstractmethod
    def _images(self, scene: Scene) -> dict[str, np.ndarray]:
        """Return the images, [C, H, W] each, by key."""

    def _is_holding(self, scene: Scene) -> bool:
        """Whether the gripper holds something."""
        return scene.robot.held_body() is not None

    @abstractmethod
    def _expert_action(self, scene: Scene) -> np.ndarray:
        """Return the expert's action."""

    # -- public ------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        """World, robot and task as they are now.

        Raises:
            SimulationError: the environment was not reset yet.
        """
        if self._scene is None:
            raise SimulationError("reset the environment first")
        return self._scene

    def render(self, width: int = 480, height: int = 360) -> np.ndarray:
        """Return a picture of the scene for people, [height, width, 3] uint8."""
        x, y = self.workspace.center
        floor = self.config.floor_color or LIGHT_FLOOR
        aside, z, distance = self.camera_pose
        return render_rgb(
            self.scene.world,
            (x + aside, y, z),
            width,
            height,
            distance_m=distance,
            floor_rgb=floor,
        )

    def get_state(self) -> EnvState:
        """Return the whole state, to come back to with `set_state`.

        It lives in this process and costs a few milliseconds; ten thousand of them cost memory.
        The future from here is that from `set_state`, bit by bit; had nobody asked, it might
        differ in the last bits. Tasks with a clutter or a bin go on in a world built anew, here
        and after each `set_state`: that takes tenths of a second.

        Raises:
            SimulationError: the environment was not reset yet.
        """
        scene = self.scene
        needs_fresh_world = self.task_class.needs_fresh_world
        state = EnvState(
            owner=self._identity,
            scale=next(key for key, value in self._scenes.items() if value is scene),
            scene=scene.get_state(outlives_world=needs_fresh_world),
            observation=self._observation,
            memory=self._memory,
            base_seed=self.base_seed,
            episode=self._episode,
            step_count=self._step_count,
            ends=self._ends,
        )
        if needs_fresh_world:
            self.set_state(state)
        return state

    def set_state(self, state: EnvState) -> TensorDict:
        """Return to a state of this environment: the same actions then give the same future.

        Args:
            state: what `get_state` returned, at any time before.

        Returns:
            What was observed in it, as `step` gives under "next", without reward.

        Raises:
            SimulationError: it is the state of another environment, or of a simulation that
                failed and was rebuilt since.
        """
        if state.owner is not self._identity:
            raise SimulationError("the state is of another environment")
        if self.task_class.needs_fresh_world:
            self._drop_scenes()
        scene = self._scene_for(state.scale)
        scene.set_state(state.scene)
        self._scene = scene
        self._observation, self._memory = state.observation, state.memory
        self.base_seed, self._episode = state.base_seed, state.episode
        self._step_count = state.step_count
        self._ends = state.ends
        return self._tensordict(self._observation, **self._ends)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close every world of this environment."""
        self._drop_scenes()
        super().close(raise_if_closed=raise_if_closed)

    # -- TorchRL -----------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        self.base_seed = int(
            np.random.SeedSequence().generate_state(1)[0] if seed is None else seed
        )
        self._episode = 0

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **_: Any
    ) -> TensorDict:
        if seed is not None:
            self._set_seed(seed)
        rng = np.random.default_rng([self.base_seed, self._episode])
        self._episode += 1
        self._step_count = 0
        afresh = self._episode == 1
        if afresh and self.task_class.needs_fresh_world:
            self._drop_scenes()
        self._scene = self._new_episode(rng, afresh)
        self._observation = self._observe(self._scene)
        self._ends = {}
        return self._tensordict(self._observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = self._checked(tensordict.get(keys.ACTION))
        scene = self.scene
        self._step_count += 1
        success = valid = False
        fault = False
        try:
            self._act(scene, action)
            scene.task.after_action()
            success, valid = self._evaluate(scene)
            self._observation = self._observe(scene)
        except Exception:
            fault = True
            self._on_fault()
        else:
            self._consecutive_faults = 0
        terminated = not fault and (success or not valid)
        at_limit = self._step_count >= self.max_steps
        if at_limit and self.task_class.terminates_at_limit:
            terminated = not fault
        truncated = fault or (at_limit and not terminated)
        self._ends = {
            keys.SUCCESS: success and not fault,
            keys.FAULT: fault,
            keys.TERMINATED: terminated,
            keys.TRUNCATED: truncated,
            keys.DONE: terminated or truncated,
        }
        reward = float(self._ends[keys.SUCCESS])
        return self._tensordict(self._observation, reward=reward, **self._ends)

    # ----------------------------------------------------------------------------------------

    def _make_specs(self) -> None:
        def flag() -> Binary:
            return Binary(n=1, shape=(1,), dtype=torch.bool)

        action = self._make_action_spec()
        images = self._declare_images() if self.config.obs_type == "pixel" else {}
        self.images = {**images, **self._extras.images()}
        """Declaration of each image that is observed, by key."""
        seen = {key: image.to_tensor_spec() for key, image in self.images.items()}
        seen |= self._extras.specs(self._scene_for(float(self._scales[-1])))
        observation = {
            **seen,
            keys.HOLDING: flag(),
            keys.SUCCESS: flag(),
            keys.FAULT: flag(),
            keys.STEP_COUNT: Unbounded(shape=(1,), dtype=torch.int64),
        }
        if self.config.expert:
            observation[keys.EXPERT_ACTION] = action.clone()
        self.observation_spec = Composite(observation)
        self.action_spec = action
        self.reward_spec = Bounded(0.0, 1.0, shape=(1,), dtype=torch.float32)
        self.full_done_spec = Composite(
            {key: flag() for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}
        )

    def _check_feasible(self) -> None:
        """Fail now, not in a worker, if the objects or the robot do not fit the workspace."""
        check_action_limits(
            self._scene_for(float(self._scales[-1])).robot, self.workspace, self._heights_to_reach
        )
        for scale in {float(self._scales[0]), float(self._scales[-1])}:
            try:
                self._start(self._scene_for(scale), np.random.default_rng(0))
            except PlacementError as error:
                raise ConfigError(f"{self.task_id}: {error}") from None

    def _scene_for(self, scale: float) -> Scene:
        """Return the sealed world for objects of this scale, building it the first time."""
        key = round(scale, 6)
        if key not in self._scenes:
            self._scenes[key] = build_scene(
                self.task_id,
                self.config,
                workspace=self.workspace,
                limits=self.action_limits,
                scale=scale,
                physics=self.physics,
                make_motion=self._make_motion,
            )
        return self._scenes[key]

    def _drop_scenes(self) -> None:
        for scene in self._scenes.values():
            scene.world.close()
        self._scenes.clear()
        self._scene = None

    def _new_episode(self, rng: np.random.Generator, afresh: bool) -> Scene:
        """Return a scene at the start of an episode: with new objects, or the last one's."""
        scene = self._scene
        if scene is not None and not afresh and scene.task.continues:
            scene.task.resume()
            self._place_robot(scene)
            scene.world.settle(max_steps=SETTLE_STEPS)
            if scene.task.is_start():
                return scene
        scene = self._scene_for(float(rng.choice(self._scales)))
        self._start(scene, rng)
        return scene

    def _start(self, scene: Scene, rng: np.random.Generator) -> None:
        """Bring new objects into a scene.

        Raises:
            PlacementError: no attempt gave a valid scene that still has to be solved.
        """
        invalid = 0
        for _ in range(RESET_ATTEMPTS):
            scene.world.restore_pristine()
            self._place_robot(scene)
            scene.task.randomise(rng)
            scene.world.settle(max_steps=SETTLE_STEPS)
            if scene.task.is_start():
                return
            invalid += not scene.task.is_valid()
        raise PlacementError(
            f"of {RESET_ATTEMPTS} random scenes {invalid} had an object outside the workspace and "
            f"{RESET_ATTEMPTS - invalid} were solved from the start; objects of this size need "
            "another workspace"
        )

    def _evaluate(self, scene: Scene) -> tuple[bool, bool]:
        """Return whether the goal holds, once everything is at rest, and the scene is valid."""
        if not math.isfinite(sum(map(sum, (body.position for body in scene.world.bodies)))):
            raise SimulationError("a body's position is not finite")
        success = scene.task.is_goal()
        if success:
            scene.world.settle(max_steps=SETTLE_STEPS)
            success = scene.task.is_goal()
        valid = scene.task.is_valid()
        return valid and success, valid

    def _observe(self, scene: Scene) -> dict[str, torch.Tensor]:
        observation = {keys.HOLDING: torch.tensor([self._is_holding(scene)])}
        if self.config.obs_type == "pixel":
            for key, image in self._images(scene).items():
                observation[key] = torch.from_numpy(image.astype(np.float32))
        observation |= self._extras.observe(scene)
        if self.config.expert:
            observation[keys.EXPERT_ACTION] = torch.from_numpy(self._expert_action(scene))
        return observation

    def _tensordict(
        self,
        observation: dict[str, torch.Tensor],
        *,
        reward: float | None = None,
        **ends: bool,
    ) -> TensorDict:
        out = {key: value.clone() for key, value in observation.items()}
        out[keys.STEP_COUNT] = torch.tensor([self._step_count])
        if reward is not None:
            out[keys.REWARD] = torch.tensor([reward])
        for key in (keys.SUCCESS, keys.FAULT, keys.DONE, keys.TERMINATED, keys.TRUNCATED):
            out[key] = torch.tensor([ends.get(key, False)])
        return TensorDict(out, batch_size=[])

    def _checked(self, action: torch.Tensor | None) -> np.ndarray:
        (size,) = self.action_spec.shape
        if action is None:
            raise InvalidActionError(f"the input has no {keys.ACTION!r}: write it before step()")
        if action.shape != (size,) or action.dtype != torch.float32:
            raise InvalidActionError(
                f"{self.task_id} takes a float32 action of shape ({size},), one component per "
                f"letter of {self.action_sequence!r}; got {action.dtype} of shape "
                f"{tuple(action.shape)}"
            )
        array = action.detach().numpy()
        if not np.isfinite(array).all():
            raise InvalidActionError(f"the action is not finite: {array.tolist()}")
        return array

    def _on_fault(self) -> None:
        """Count and report a simulator fault; the next reset starts with a new world."""
        self.faults += 1
        self._consecutive_faults += 1
        logger.exception("%s: simulator fault %d, episode dropped", self.task_id, self.faults)
        self._drop_scenes()
        if self._consecutive_faults > MAX_CONSECUTIVE_FAULTS:
            raise SimulationError(
                f"{self.task_id} failed {self._consecutive_faults} times in a row; the log above "
                "shows the cause"
            )
