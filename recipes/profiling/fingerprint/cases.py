"""The cases of a fingerprint: tasks, robots, options and training runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import ba_torchrl
from ba_torchrl.tasks.base import TASKS

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
PARTS = ("envs", "training")
ROBOTS = ("kuka", "panda", "ur5", "ur5_robotiq")
SEED = 7

FOLLOWING_VIEWS = [f"camera_center_{axes}" for axes in ("xyz", "xyzr", "xyr", "xy", "z")]
HEIGHT_VIEWS = [*FOLLOWING_VIEWS, "camera_fix", "render_center", "camera_side"]
VIEWS = [
    *HEIGHT_VIEWS,
    *(f"{view}_height" for view in HEIGHT_VIEWS),
    "camera_side_rgbd",
    "pers_center_xyz",
]

OPTIONS: dict[str, dict[str, Any]] = {
    "vec": {"obs_type": "vec"},
    "rgb": {"rgb": True},
    "point_cloud": {"point_cloud": 256},
    "half_rotation": {"half_rotation": True},
    "whole_rotation": {"half_rotation": False},
    "bounding_box": {"workspace_check": "bounding_box"},
    "slow_motion": {"fast_mode": False},
    "slow_physics": {"physics_mode": "slow"},
    "custom_physics": {"physics_mode": "custom", "time_step_s": 1 / 300, "solver_iterations": 40},
    "fixed_yaw": {"random_orientation": False},
    "small_image": {"obs_size": 32},
    "three_steps": {"max_steps": 3},
    "one_scale": {"object_scale_range": 0.7},
    "colors": {"rgb": True, "floor_color": [0.2, 0.4, 0.1], "workspace_color": [0.9, 0.8, 0.7]},
    "cylinder": {"object_type": "cylinder"},
    "household": {"object_set": "household"},
    "tray": {"close_loop_tray": True},
    "steps_of_control": {"dpos": 0.03, "drot": math.pi / 8},
    "view_scale": {"view_scale": 1.0},
    "in_hand_sub": {"in_hand_mode": "sub"},
    "in_hand_proj": {"in_hand_mode": "proj"},
    "in_hand_size": {"in_hand_size": 32},
    "top_down": {"top_down_approach": True},
    "top_down_tilted": {"top_down_approach": True, "action_sequence": "pxyzrrr"},
    "in_hand_sub_tilted": {"in_hand_mode": "sub", "action_sequence": "pxyzrrr"},
    "two_angles": {"action_sequence": "pxyzrr"},
    "no_primitive": {"action_sequence": "xyr"},
    "with_height": {"action_sequence": "pxyzr"},
    "other_order": {"action_sequence": "ryxp"},
    **{f"num_objects_{n}": {"num_objects": n} for n in (1, 2, 3, 4, 5, 8, 12, 18)},
}
"""Variants of every task with the robot kuka; a refused configuration is recorded as well."""
SLOW_TASKS = ("close_loop/object_grasping", "open_loop/bin_packing", "open_loop/object_grasping")
"""Tasks with slow resets, of which fewer actions are recorded."""
VIEW_TASKS = ("close_loop/block_picking", "close_loop/drawer_opening")
STEPPED_TOGETHER = {"close_loop/block_stacking", "open_loop/house_building_1"}

CLOSE_LOOP_TASK, OPEN_LOOP_TASK = "close_loop/block_picking", "open_loop/block_stacking"
SMALL_RUN: dict[str, Any] = {
    "device": "cpu",
    "threads": 1,
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 3,
    "pretrain_updates": 8,
    "total_updates": 30,
    "min_replay": 5,
    "eval_every": 15,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "log_every": 1,
    "video_episodes": 0,
    "label": "small",
    "env.obs_size": 64,
    "algorithm.batch_size": 4,
    "algorithm.replay.capacity": 1000,
}
SMALL_CLOSE_LOOP = {"env.max_steps": 10}
SMALL_OPEN_LOOP = {"env.max_steps": 6, "algorithm.target_interval": 10}
SMALL_NETWORK: dict[str, dict[str, Any]] = {
    "cnn": {"network.width": 0.25},
    "equi": {"network.n_hidden": 8},
    "equi_small": {"network.n_hidden": 8},
    "equi_d4": {"network.n_hidden": 8},
    "ferm": {"network.width": 0.25},
    **{
        name: {"network.width": 0.25, "network.num_rotations": 4}
        for name in ("asr", "equi_asr", "equi_fcn", "fcn", "rot_fcn")
    },
    "equi_deictic_asr": {
        "network.width": 0.25,
        "network.num_rotations": 4,
        "network.num_z": 6,
        "env.action_sequence": "pxyzrrr",
        "env.in_hand_mode": "proj",
    },
}

OPEN_LOOP_METHODS = ("adet", "dqfd", "dqn", "sdqfd")
METHODS = (
    *OPEN_LOOP_METHODS,
    *("bc", "dagger", "iql", "rlpd", "sac_so2", "sacfd_so2", "sacfd_per_so2"),
    *(
        f"{views}{method}"
        for views in ("", "rad_", "drq_", "ferm_")
        for method in ("sac", "sacfd", "sacfd_per")
    ),
)

TRAINING_OPTIONS: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "uniform": (
        CLOSE_LOOP_TASK,
        "sac",
        "cnn",
        {"algorithm__replay__name": "uniform", "algorithm__rotation__name": "none"},
    ),
    "prioritized sac": (CLOSE_LOOP_TASK, "sac_so2", "cnn", {"replay": "per"}),
    "without yaw": (
        CLOSE_LOOP_TASK,
        "sacfd_per_so2",
        "equi_small",
        {"env__action_sequence": "pxyz", "env__random_orientation": False},
    ),
    "128 pixels": (CLOSE_LOOP_TASK, "sacfd_per_so2", "cnn", {"env__obs_size": 128}),
    "schedules": (
        CLOSE_LOOP_TASK,
        "sacfd_per_so2",
        "cnn",
        {
            "algorithm__optimizer__learning_rate_end_factor": 0.1,
            "algorithm__optimizer__weight_decay": 1e-4,
            "algorithm__optimizer__gradient_clamp": 0.1,
            "updates_per_step": 2,
        },
    ),
    "quickstart": (CLOSE_LOOP_TASK, "sacfd_per_so2", "equi_small", {"file": "quickstart"}),
    "quickstart_open_loop": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "equi_asr",
        {"file": "quickstart_open_loop", "env__num_objects": 2},
    ),
    "replay prioritized, se2": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "fcn",
        {"algorithm__replay__name": "prioritized", "algorithm__rotation__name": "se2"},
    ),
    "replay prioritized, d4": (
        OPEN_LOOP_TASK,
        "dqfd",
        "asr",
        {"algorithm__replay__name": "prioritized", "algorithm__rotation__name": "d4"},
    ),
    "replay uniform, translation": (
        OPEN_LOOP_TASK,
        "dqn",
        "asr",
        {"algorithm__replay__name": "uniform", "algorithm__rotation__name": "translation"},
    ),
    "replay split, cn": (
        OPEN_LOOP_TASK,
        "adet",
        "fcn",
        {"algorithm__replay__name": "symmetric", "algorithm__rotation__name": "cn"},
    ),
    "random actions": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "asr",
        {"algorithm__epsilon_init": 0.8, "algorithm__epsilon_end": 0.2},
    ),
    "open loop without yaw": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "equi_fcn",
        {"env__action_sequence": "pxy", "env__random_orientation": False},
    ),
    "whole rotation": (OPEN_LOOP_TASK, "sdqfd", "asr", {"env__half_rotation": False}),
    "in_hand proj": (OPEN_LOOP_TASK, "sdqfd", "asr", {"env__in_hand_mode": "proj"}),
    "six degrees of freedom": (
        OPEN_LOOP_TASK,
        "sdqfd",
        "asr",
        {"env__action_sequence": "pxyzrrr", "env__in_hand_mode": "proj"},
    ),
    "deconstruction": (
        "open_loop/house_building_1",
        "sdqfd",
        "fcn",
        {"demonstrations_source": "deconstruction", "only_successful_demonstrations": True},
    ),
    "processes": (CLOSE_LOOP_TASK, "sacfd_per_so2", "cnn", {"parallel": True}),
}
"""Variants of training: task, method, network and overrides, "__" for a dot."""


@dataclass(frozen=True)
class Case:
    """A run to record, determined by its fields."""

    name: str
    part: str
    task: str
    kind: str
    """"env", "state", "vector", "parallel", "gym" or "training"."""
    config: dict[str, Any] = field(default_factory=dict)
    """Keywords of the environment, or Hydra's overrides of a training run."""
    plan: dict[str, int] = field(default_factory=dict)
    """Numbers of expert episodes, random actions and noisy expert actions."""
    seed: int = SEED


def cases(parts: Iterable[str]) -> list[Case]:
    """Return the cases of some of `PARTS`."""
    known = {"envs": _env_cases, "training": _training_cases}
    return [case for part in PARTS if part in parts for case in known[part]()]


def _env_cases() -> Iterator[Case]:
    def case(name: str, kind: str, plan: dict[str, int] | None = None, **config: Any) -> Case:
        return Case(f"envs {task} {name}", "envs", task, kind, config, plan or {})

    long = {"expert": 2, "random": 10, "near": 10}
    short = {"expert": 1, "random": 5, "near": 5}
    brief = {"expert": 1, "random": 2, "near": 2}
    for task in ba_torchrl.list_tasks():
        is_open = TASKS[task].control == "open_loop"
        turning, fixed = ("pxyr", "pxy") if is_open else ("pxyzr", "pxyz")
        for robot in ROBOTS:
            plan = long if robot == "kuka" else brief if task in SLOW_TASKS else short
            size = {} if robot == "kuka" else {"obs_size": 64}
            yield case(
                f"{robot} {turning}", "env", plan, robot=robot, action_sequence=turning, **size
            )
            yield case(
                f"{robot} {fixed}",
                "env",
                plan,
                robot=robot,
                action_sequence=fixed,
                random_orientation=False,
                obs_size=64,
            )
            if is_open:
                yield case(
                    f"{robot} tilted",
                    "env",
                    plan,
                    robot=robot,
                    action_sequence="pxyzrrr",
                    obs_size=64,
                )
        for name, option in OPTIONS.items():
            plan = brief if task in SLOW_TASKS else short
            yield case(f"option {name}", "env", plan, **{"obs_size": 64, **option})
        if task in VIEW_TASKS:
            for view in VIEWS:
                yield case(f"view {view}", "env", short, view_type=view, obs_size=64)
        yield case("without expert", "env", {"random": 10}, expert=False, obs_size=64)
        yield case("state", "state", obs_size=64)
        yield case("vector", "vector", obs_size=64)
        if task in STEPPED_TOGETHER:
            yield case("parallel", "parallel", obs_size=64)
        yield case("gymnasium", "gym", obs_size=64)


def _training_cases() -> Iterator[Case]:
    """Yield every pair of a method and a network preset, and some options."""
    networks = sorted(path.stem for path in (CONFIGS / "network").glob("*.yaml"))
    for method, network in product(METHODS, networks):
        task = OPEN_LOOP_TASK if method in OPEN_LOOP_METHODS else CLOSE_LOOP_TASK
        yield _training_case(f"{method} {network}", task, method, network)
    for name, (task, method, network, changes) in TRAINING_OPTIONS.items():
        yield _training_case(f"option {name}", task, method, network, **changes)


def _choices(method: str) -> dict[str, Any]:
    """Return the presets of a method; "sac" after the first leaves out the behaviour term."""
    algorithm, *others = method.split("_")
    chosen = {
        "algorithm": algorithm,
        "replay": "per" if "per" in others else "uniform",
        "rotation": "so2" if "so2" in others else "none",
    }
    return {**chosen, "algorithm.imitation.name": "none"} if "sac" in others else chosen


def _training_case(
    name: str, task: str, method: str, network: str, file: str = "train", **changes: Any
) -> Case:
    small = SMALL_CLOSE_LOOP if TASKS[task].control == "close_loop" else SMALL_OPEN_LOOP
    if method.startswith("ferm"):
        small = {**small, "env.obs_size": 71, "algorithm.views.size": 64}
        small |= {"algorithm.contrastive.updates": 8, "pretrain_updates": 0}
    config = {
        "file": file,
        "task": task,
        **_choices(method),
        "network": network,
        **SMALL_RUN,
        **small,
        **SMALL_NETWORK.get(network, {}),
        **{name.replace("__", "."): value for name, value in changes.items()},
    }
    return Case(f"training {name}", "training", task, "training", config)
