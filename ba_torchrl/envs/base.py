"""BulletArmEnv: a task, a robot and a world as a TorchRL environment."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Iterator
from pkgutil import resolve_name
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, PlacementError, SimulationError
from ba_torchrl.core.hardware import existing_device
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.envs.checks import ChecksPolicy, check_entries, check_seed, checked_action
from ba_torchrl.envs.episodes import EnvState, Episodes, evaluate_at_rest
from ba_torchrl.envs.faults import FaultCounter, check_bodies, check_observation
from ba_torchrl.envs.look_ahead import expert_chunk
from ba_torchrl.envs.observations import (
    enabled_observations,
    merge_entries,
    segmentation_names,
)
from ba_torchrl.envs.rendering import WORKSPACE_VIEW, Direction, RelativePoint, scene_viewpoint
from ba_torchrl.envs.scene import Controller, Scene, build_scene, check_action_limits
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.vision.camera import Camera
from ba_torchrl.sim.vision.rgb import DEFAULT_FLOOR_RGB, render_rgb
from ba_torchrl.sim.world import SIMULATOR_ERRORS, Physics, World
from ba_torchrl.tasks.base import SCALE_STEP, TASKS, Task
from ba_torchrl.tasks.workspace import ActionLimits

_CHUNK = (keys.EXPERT_CHUNK, keys.EXPERT_CHUNK_MASK)


class _OfClass:
    """A property of a class and of its instances.

    Args:
        compute: from the class to the value.
    """

    def __init__(self, compute: Callable[[type], Any]) -> None:
        self._compute = compute

    def __get__(self, instance: object, owner: type) -> Any:
        return self._compute(owner)


class _MadeByTask(type(EnvBase)):
    """Metaclass: a call of `BulletArmEnv` makes an environment of the class of its task's control.

    Its subclasses are called with a `ResolvedEnv`.
    """

    def __call__(
        cls,
        task: str | ResolvedEnv,
        *,
        device: torch.device | str | int | None = None,
        **config: Any,
    ) -> BulletArmEnv:
        place = None if device is None else existing_device(device)
        if cls is BulletArmEnv:
            resolved = resolve_env(task, config)
            env = resolve_name(resolved.control.env)(resolved)
        elif not isinstance(task, ResolvedEnv):
            raise TypeError(
                f"{cls.__name__} takes what resolve_env returned, not {task!r}: call BulletArmEnv"
            )
        else:
            env = super().__call__(task, **config)
        return env if place is None else env.to(place)


class BulletArmEnv(ChecksPolicy, EnvBase, metaclass=_MadeByTask):
    """A manipulation task as an unbatched TorchRL environment.

    The seed determines the episodes: episode n of seed s is the same in any process and after any
    other episodes. Exceptions are tasks that continue with the objects of the previous episode.

    Args:
        task: one of `available_envs`, or what `resolve_env` returned.
        device: of its TensorDicts, the CPU by default. The simulation is on the CPU.
        config: fields of `ba_torchrl.core.env_config.EnvConfig`, such as ``robot="kuka"``,
            ``seed=0`` or ``expert=True``.

    Raises:
        ConfigError: the task or a parameter is unknown, its value cannot be used, or the workspace
            does not suit the objects or the robot.

    Examples:
        >>> from ba_torchrl import BulletArmEnv
        >>> env = BulletArmEnv("open_loop/block_stacking", seed=0, expert=True)
        >>> state = env.reset()
        >>> step = env.step(state.set("action", state["expert_action"]))
        >>> state["heightmap"].shape, bool(step["next", "holding"])
        (torch.Size([1, 128, 128]), True)
        >>> env.close()
    """

    _supports_set_state = True

    def __init__(self, resolved: ResolvedEnv) -> None:
        # a state of `get_state` may be that after the last step of an episode
        super().__init__(device="cpu", batch_size=[], allow_done_after_reset=True)
        self.resolved = resolved
        self.task_id, self.task_class = resolved.task_id, resolved.task_class
        self.config = resolved.config
        """The parameters, with every default filled in."""
        self.max_steps = self.config.max_steps
        self.workspace = resolved.workspace
        self.actions = resolved.actions
        """The action space."""
        low, high = self.config.object_scale_range
        scales = np.arange(low, high + 1e-9, SCALE_STEP)
        self._episodes = Episodes(scales, self._build_scene, self._place_robot)
        self._observation: dict[str, torch.Tensor] = {}
        self._observations = enabled_observations(self.config, self.workspace)
        self._memory: dict[str, Any] = {}  # of observations; it is replaced, never modified
        self._ends: dict[str, bool] = {}
        """Flags of the last step, by key."""
        self._conditions: dict[str, bool] | None = None
        """The conditions of success after the last step, None before the first."""
        self._instruction = ""
        self._progress = 0.0
        """The task's progress in the present state, for dense rewards."""
        self._step_count = 0
        self._fault_counter = FaultCounter(self.task_id)
        self.on_contact: Callable[[], None] | None = None
        """Called in an open-loop step at each grasp and before each release, for videos."""
        self._set_seed(self.config.seed)
        self._make_specs()
        self._check_feasible()

    # -- for subclasses ----------------------------------------------------------------------

    physics: ClassVar[Physics] = Physics()
    """Settings of the physics engine for ``physics_mode="fast"``."""
    hand_point: ClassVar[RelativePoint] = RelativePoint(0.0, 0.0, 0.28)
    """A point of the hand that `render` shows besides the workspace."""
    video_caption: ClassVar[str] = ""
    """Text in every frame of a video."""

    @abstractmethod
    def _make_controller(self, robot: Robot, task: Task) -> Controller:
        """Return the controller that executes actions."""

    @property
    @abstractmethod
    def action_limits(self) -> ActionLimits:
        """Largest displacement and rotation of one action."""

    @property
    @abstractmethod
    def _required_tool_heights(self) -> tuple[float, ...]:
        """Heights of the tool that the arm must reach at every corner of the workspace."""

    @abstractmethod
    def _make_action_spec(self) -> Bounded:
        """Return the specification of an action."""

    @abstractmethod
    def _declare_images(self) -> dict[str, ImageSpec]:
        """Return the declarations of the images that `_images` returns, by key."""

    @abstractmethod
    def _place_robot(self, scene: Scene) -> None:
        """Move the robot to the initial pose of an episode."""

    @abstractmethod
    def _act(self, scene: Scene, action: np.ndarray) -> None:
        """Execute an action."""

    @abstractmethod
    def _images(self, scene: Scene) -> dict[str, np.ndarray]:
        """Return the images, [C, H, W] each, by key."""

    @abstractmethod
    def _cameras(self, scene: Scene) -> dict[str, Camera]:
        """Return the geometry of the images of `_images`, by key."""

    def _is_holding(self, scene: Scene) -> bool:
        """Return whether the gripper holds an object."""
        return scene.robot.held_body() is not None

    @abstractmethod
    def _expert_action(self, scene: Scene) -> np.ndarray:
        """Return the expert's action."""

    def _expert_specs(self, action: Bounded) -> dict[str, Bounded]:
        """Return the specifications of `_expert_entries`, from the specification of actions."""
        return {keys.EXPERT_ACTION: action.clone()}

    def _expert_entries(self, scene: Scene) -> dict[str, np.ndarray]:
        """Return what the observation tells of the expert, by key."""
        return {keys.EXPERT_ACTION: self._expert_action(scene)}

    def _rendered_world(self, scene: Scene) -> World:
        """Return the world that `render` shows."""
        return scene.world

    # -- public ------------------------------------------------------------------------------

    @_OfClass
    def available_envs(cls) -> list[str]:
        """Ids of all tasks, plugins' included."""
        return list(TASKS)

    @property
    def scene(self) -> Scene:
        """The world, robot and task of the current episode."""
        if self._episodes.scene is None:
            raise SimulationError("reset the environment first")
        return self._episodes.scene

    @property
    def faults(self) -> int:
        """Number of simulator faults since construction, in steps and in resets."""
        return self._fault_counter.total

    @property
    def conditions(self) -> dict[str, bool]:
        """The task's named conditions of success, such as ``is_grasped``; see `Task.evaluate`.

        All are False after a simulator fault.
        """
        if self._conditions is None:
            self._conditions = self.scene.task.conditions()
        return dict(self._conditions)

    @property
    def instruction(self) -> str:
        """The goal of the episode as an English sentence; see `Task.instruction`."""
        return self._instruction

    @property
    def segmentation_names(self) -> tuple[str, ...]:
        """Names of the bodies by their index in the observation ``segmentation``."""
        return segmentation_names(self._episodes.largest_scene)

    @property
    def is_out_of_reach(self) -> bool:
        """Whether the arm could not reach the pose of the last action; see `Controller`."""
        return self._ends.get(keys.IS_OUT_OF_REACH, False)

    def render(self, width: int = 480, height: int = 360) -> np.ndarray:
        """Return an RGB image of the scene, [height, width, 3] uint8."""
        hand_m = np.array(self.hand_point.above(self.scene.task.terrain))
        return self._draw(self._rendered_world(self.scene), hand_m, width, height)

    def video_images(
        self, width: int, height: int, *, at_contact: bool = False
    ) -> Iterator[np.ndarray]:
        """Yield a video's images since the last call, [height, width, 3] uint8.

        They have no effect on the simulation. The first call follows `reset`, the others each step.

        Args:
            at_contact: `on_contact` makes the call.
        """
        yield self.render(width, height)

    def camera(self, key: str) -> Camera:
        """Return where the camera of an observed image is, and what its pixels show.

        Args:
            key: of the image: ``depth``, ``heightmap``, ``rgb``, ``rgb_depth``, ``wrist_rgb`` or
                ``segmentation``.

        Returns:
            The geometry of the last observation. Cameras that follow the gripper move.

        Raises:
            ConfigError: the environment does not observe the image.

        Examples:
            >>> env = BulletArmEnv("close_loop/block_picking", rgb=True, seed=0)
            >>> td = env.reset()
            >>> env.camera("rgb_depth").points(td["rgb_depth"].numpy()).shape
            (128, 128, 3)
            >>> env.close()
        """
        own = self._cameras(self.scene) if self.config.obs_type == "pixel" else {}
        others = (extra.cameras(self.scene) for extra in self._observations)
        cameras = merge_entries([own, *others])
        if key not in cameras:
            seen = ", ".join(cameras) or "none; obs_type='pixel' and rgb=True add some"
            raise ConfigError(f"{self.task_id}: no camera observes {key!r}. Observed: {seen}")
        return cameras[key]

    def get_state(self) -> TensorDict:
        """Return the full state, which ``reset(state, set_state=True)`` restores.

        Where TorchRL passes no such entry, ``reset(set_state=True, state=state)`` does: in a
        `TransformedEnv`, or with ``list_of_kwargs`` in a `ParallelEnv` with buffers.

        It takes a few milliseconds, and is valid in every environment of the same task and
        parameters but for the seed, in any process. The steps after this call and after that reset
        are the same bit for bit; steps without this call may differ from them in the last bits.

        Returns:
            A TensorDict with the entry ``state``.
        """
        return TensorDict({keys.STATE: NonTensorData(self._get_state())}, [], device=self.device)

    def _get_state(self) -> EnvState:
        scene = self.scene
        return EnvState(
            origin=self._origin,
            scale=self._episodes.scale(),
            scene=scene.get_state(),
            observation=self._observation,
            memory=self._memory,
            base_seed=self.base_seed,
            episode=self._episode,
            step_count=self._step_count,
            ends=self._ends,
            progress=self._progress,
        )

    @property
    def _origin(self) -> tuple[type, str, dict[str, Any]]:
        return type(self), self.task_id, self.config.model_dump(exclude={"seed", "render"})

    def _set_state(self, tensordict: TensorDictBase | None) -> TensorDict:
        """Restore a state and return its entries."""
        if tensordict is None or keys.STATE not in tensordict.keys():  # noqa: SIM118
            raise ConfigError(
                f"reset(td, set_state=True) needs the entry {keys.STATE!r} of get_state(). Where "
                "TorchRL drops it (TransformedEnv, ParallelEnv with buffers), use "
                "reset(set_state=True, state=td)"
            )
        state = tensordict[keys.STATE]
        if not isinstance(state, EnvState):
            raise ConfigError(
                f"the entry {keys.STATE!r} is not from get_state() of one environment, but "
                f"{type(state).__name__}; for several, reset(set_state=True, "
                'list_of_kwargs=[{"state": each} for each in states])'
            )
        if state.origin != self._origin:
            raise ConfigError("the state is of an environment with another task or parameters")
        self._episodes.restore(state.scale, state.scene)
        self._observation, self._memory = state.observation, state.memory
        self.base_seed, self._episode = state.base_seed, state.episode
        self._step_count = state.step_count
        self._ends, self._conditions = state.ends, None
        self._instruction = self.scene.task.instruction()
        self._progress = state.progress
        return self._tensordict(self._observation, **self._ends)

    def __repr__(self) -> str:
        images = ", ".join(
            f"{key} {' x '.join(map(str, image.shape))}" for key, image in self.images.items()
        )
        return (
            f"{type(self).__name__}({self.task_id}, {self.config.robot}, "
            f"{images or self.config.obs_type}, action {self.actions.sequence})"
        )

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all worlds of this environment."""
        self._episodes.close()
        super().close(raise_if_closed=raise_if_closed)

    # -- TorchRL -----------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = np.random.SeedSequence().generate_state(1)[0]
        check_seed(seed)
        self.base_seed = int(seed)
        self._episode = 0

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | None = None,
        set_state: bool = False,
        state: TensorDictBase | None = None,
    ) -> TensorDict:
        self._fault_counter.episodes.count_reset()
        if set_state:
            return self._set_state(tensordict if state is None else state)
        if state is not None:
            raise ConfigError("state= needs set_state=True beside it, also with list_of_kwargs")
        if seed is not None:
            self._set_seed(seed)
        self._episode += 1
        self._step_count = 0
        self._observation = self._begin_episode(with_new_objects=self._episode == 1)
        self._ends, self._conditions = {}, None
        return self._tensordict(self._observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = checked_action(tensordict.get(keys.ACTION), self.task_id, self.actions.sequence)
        scene = self.scene
        self._step_count += 1
        success = valid = fault = False
        try:
            with self._acting():
                self._act(scene, action)
                self._conditions, valid = evaluate_at_rest(scene)
                success = valid and all(self._conditions.values())
                self._observation = self._observe(scene)
                before, self._progress = self._progress, self._measure_progress(scene)
        except SIMULATOR_ERRORS as error:
            fault, self._conditions = True, dict.fromkeys(self._condition_names, False)
            self._on_fault(error)
        else:
            self._fault_counter.episodes.count_step()
        # the dense rewards that would follow a success belong to its value
        cuts_rewards = success and self.config.reward == "dense"
        terminated = not fault and not cuts_rewards and (success or not valid)
        at_limit = cuts_rewards or self._step_count >= self.max_steps
        if at_limit and self.task_class.terminates_at_limit:
            terminated = not fault
        truncated = fault or (at_limit and not terminated)
        self._ends = {
            keys.SUCCESS: success and not fault,
            keys.FAULT: fault,
            keys.TERMINATED: terminated,
            keys.TRUNCATED: truncated,
            keys.DONE: terminated or truncated,
            keys.IS_OUT_OF_REACH: scene.controller.is_out_of_reach,
        }
        reward = float(self._ends[keys.SUCCESS])
        if self.config.reward != "sparse" and not fault:
            reward = self._dense_reward(before, reward)
        return self._tensordict(self._observation, reward=reward, **self._ends)

    # ----------------------------------------------------------------------------------------

    def _make_specs(self) -> None:
        def flag() -> Binary:
            return Binary(1, device="cpu", dtype=torch.bool)

        action = self._make_action_spec()
        images = self._declare_images() if self.config.obs_type == "pixel" else {}
        self.images = merge_entries([images, *(extra.images() for extra in self._observations)])
        """Declaration of each image that is observed, by key."""
        seen = {key: image.to_tensor_spec() for key, image in self.images.items()}
        largest = self._episodes.largest_scene
        general = {key: flag() for key in (keys.HOLDING, keys.SUCCESS, keys.FAULT)}
        general[keys.STEP_COUNT] = Unbounded((1,), device="cpu", dtype=torch.int64)
        if self.config.expert:
            general |= self._expert_specs(action)
        if horizon := self.config.expert_chunk:
            general[keys.EXPERT_CHUNK] = action.expand(horizon, *action.shape).clone()
            general[keys.EXPERT_CHUNK_MASK] = Binary(horizon, device="cpu", dtype=torch.bool)
        extras = merge_entries([extra.specs(largest) for extra in self._observations])
        self.vectors = {
            key: spec.shape[0]
            for key, spec in extras.items()
            if len(spec.shape) == 1 and spec.dtype.is_floating_point
        }
        """Length of each vector of floats that is observed, by key."""
        self.declared = merge_entries([extra.vectors(largest) for extra in self._observations])
        """Declaration of each vector and of points, by key."""
        self.observation_spec = Composite(merge_entries([seen, extras, general]), device="cpu")
        self.action_spec = action
        # unbounded, since TorchRL's transforms of rewards take no other specification
        self.reward_spec = Unbounded((1,), device="cpu", dtype=torch.float32)
        self.full_done_spec = Composite(
            {key: flag() for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}, device="cpu"
        )

    def _check_feasible(self) -> None:
        """Check before any worker starts that the workspace suits the objects and the robot."""
        largest = self._episodes.largest_scene
        check_action_limits(largest.robot, self.workspace, self._required_tool_heights)
        try:
            self._episodes.check_starts()
        except PlacementError as error:
            raise ConfigError(f"{self.task_id}: {error}") from None
        self._condition_names = tuple(largest.task.conditions())

    def _draw(
        self,
        world: World,
        arm_m: np.ndarray,
        width: int,
        height: int,
        direction: Direction = WORKSPACE_VIEW,
    ) -> np.ndarray:
        """Return an image of the workspace and of points of the arm; see `scene_viewpoint`."""
        terrain = self.scene.task.terrain
        viewpoint = scene_viewpoint(world, terrain, arm_m, width / height, direction)
        floor = self.config.floor_color or DEFAULT_FLOOR_RGB
        return render_rgb(world, viewpoint, width, height, floor_rgb=floor)

    def _build_scene(self, scale: float, *, window: bool | None = None) -> Scene:
        return build_scene(
            self.task_class,
            self.resolved.task_settings(scale, self.action_limits),
            self.config,
            physics=self.physics,
            make_controller=self._make_controller,
            window=self.config.render if window is None else window,
        )

    def _observe(self, scene: Scene) -> dict[str, torch.Tensor]:
        observation = {keys.HOLDING: torch.tensor([self._is_holding(scene)], device="cpu")}
        if self.config.obs_type == "pixel":
            for key, image in self._images(scene).items():
                observation[key] = torch.from_numpy(image.astype(np.float32))
        for extra in self._observations:
            observation |= extra.observe(scene)
        horizon = self.config.expert_chunk
        if self.config.expert or horizon:
            with scene.world.fixed_poses():  # experts read the same poses many times
                entries = self._expert_entries(scene)
            if self.config.expert:
                observation |= {key: torch.from_numpy(value) for key, value in entries.items()}
        if horizon:
            action = entries[keys.EXPERT_ACTION]
            found = expert_chunk(scene, action, horizon, self._act, self._expert_action)
            for key, value in zip(_CHUNK, found, strict=True):
                observation[key] = torch.from_numpy(value)
        check_observation(observation)
        return observation

    def _tensordict(
        self,
        observation: dict[str, torch.Tensor],
        *,
        reward: float | None = None,
        **ends: bool,
    ) -> TensorDict:
        out = {key: value.clone() for key, value in observation.items()}
        out[keys.STEP_COUNT] = torch.tensor([self._step_count], device="cpu")
        if reward is not None:
            out[keys.REWARD] = torch.tensor([reward], device="cpu", dtype=torch.float32)
        flags = torch.tensor([[ends.get(key, False)] for key in keys.STEP_FLAGS], device="cpu")
        out |= zip(keys.STEP_FLAGS, flags.unbind(), strict=True)
        return TensorDict(out, batch_size=[], device=self.device)

    def _begin_episode(self, *, with_new_objects: bool) -> dict[str, torch.Tensor]:
        """Start an episode, again in a new world after a fault, and return its observation."""
        while True:
            rng = np.random.default_rng([self.base_seed, self._episode - 1])
            try:
                with self._acting():
                    scene = self._episodes.begin(rng, with_new_objects=with_new_objects)
                    self._progress = self._measure_progress(scene)
                    self._instruction = scene.task.instruction()
                    observation = self._observe(scene)
                    check_entries(observation, self.observation_spec)
                    return observation
            except SIMULATOR_ERRORS as error:
                self._on_fault(error)

    @contextlib.contextmanager
    def _acting(self) -> Iterator[None]:
        """Context in which task and robot act.

        An error of the code is raised as it is, with a note on the episode, which tracebacks show
        from Python 3.11 on.

        Raises:
            SIMULATOR_ERRORS: of the simulator, or any error in a scene that is not finite.
        """
        try:
            yield
        except (*SIMULATOR_ERRORS, PlacementError):
            raise
        except Exception as error:
            if self._episodes.scene is not None:
                check_bodies(self._episodes.scene, may_be_lost=True)
            where = f"seed {self.base_seed}, episode {self._episode}, step {self._step_count}"
            note = f"{self.task_id}, {where}: an error of the code, not of the simulator"
            error.__notes__ = [*getattr(error, "__notes__", ()), note]
            raise

    def _measure_progress(self, scene: Scene) -> float:
        """Return the task's progress, 0 if the reward is sparse."""
        if self.config.reward == "sparse":
            return 0.0
        with scene.world.fixed_poses():
            value = scene.task.progress()
        with contextlib.suppress(TypeError, ValueError, RuntimeError, OverflowError):
            if 0 <= (progress := float(value)) < 1:
                return progress
        raise ConfigError(
            f"{self.task_id}: {self.task_class.__name__}.progress must be a number in [0, 1), not "
            f"{value!r}"
        )

    def _dense_reward(self, progress_before: float, sparse: float) -> float:
        """Return the reward of the last step; see `EnvConfig.reward`."""
        if self.config.reward == "dense":
            return sparse or self._progress
        progress = 0.0 if self._ends[keys.TERMINATED] else self._progress
        return sparse + self.config.reward_discount * progress - progress_before

    def _on_fault(self, error: Exception) -> None:
        """Close the worlds and count the fault; the next episode builds a new world."""
        self._episodes.close()
        self._fault_counter.count_fault(error)
