"""Times of the learner, also as multiples of a convolution, and the memory of its replay."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl import ResolvedEnv, make_vector_env
from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.algorithms.base import Learner
from ba_torchrl.algorithms.problem import network_dtype
from ba_torchrl.core import keys
from ba_torchrl.core.hardware import amx_is_used
from ba_torchrl.data.replay.codecs import DepthQuantizer, HalfPrecision, ImageCodec
from ba_torchrl.data.replay.storage import FrameStorage
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.demonstrations.collect import collect_demonstrations
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import acting_on
from ba_torchrl.training.learner import build_learner
from profiling.limits import MatrixProduct, count_multiply_adds
from profiling.table import CPU, Bench, Budget, Row, measurement, timed_row

SEED = 0
CAPACITY = 100_000


class LearningUnit:
    """A float32 3 x 3 convolution, 64 to 128 channels, 64 images of 64 x 64, and its gradient.

    Args:
        device: where it is computed.
    """

    def __init__(self, device: torch.device = CPU) -> None:
        self.convolution = nn.Conv2d(64, 128, 3, padding=1, device=device)
        self.images = torch.randn(64, 64, 64, 64, device=device, requires_grad=True)

    def __call__(self) -> None:
        """Compute the forward and the backward pass."""
        self.convolution(self.images).sum().backward()


CLOSE_LOOP = {
    "task": "close_loop/block_picking",
    "algorithm": {
        "name": "sac",
        "batch_size": 64,
        "replay": {"name": "prioritized"},
        "rotation": {"name": "sampled"},
    },
}
OPEN_LOOP = {
    "task": "open_loop/block_stacking",
    "algorithm": {"name": "spatial_q", "batch_size": 16},
}
SIX_DOF = {**OPEN_LOOP, "env": {"action_sequence": "pxyzrrr", "in_hand_mode": "proj"}}


def _config(
    bench: Bench, experiment: dict[str, Any], network: dict[str, Any], obs_size: int
) -> ExperimentConfig:
    """Return the configuration of a learner."""
    env = {**experiment.get("env", {}), "obs_size": obs_size}
    return ExperimentConfig.parse(
        {
            **experiment,
            "env": env,
            "network": {**network, "precision": bench.precision},
            "seed": SEED,
            "device": str(bench.device),
        }
    )


def _expert_episodes(
    task: str | ResolvedEnv, episodes: int, settings: dict[str, Any]
) -> tuple[float, list[TensorDict]]:
    """Return the image's largest value and the expert's episodes."""
    env = make_vector_env(task, 1, parallel=False, seed=SEED, expert=True, **settings)
    specs = env.observation_spec
    image = specs[keys.DEPTH if keys.DEPTH in specs else keys.HEIGHTMAP]
    high = float(image.space.high.max())
    played = collect_demonstrations(env, episodes, seed=SEED)
    env.close()
    return high, played


def make_learner(
    bench: Bench, experiment: dict[str, Any], network: dict[str, Any], obs_size: int
) -> Learner:
    """Return a learner with the expert's transitions in its replay.

    Args:
        bench: device of the learner and precision of its network.
        experiment: task, algorithm and fields of the environment.
        network: its name and parameters.
        obs_size: pixels of the images.
    """
    config = _config(bench, experiment, network, obs_size)
    learner = build_learner(config)
    learner.on_demonstrations(_expert_episodes(config.env, 20, {})[1])
    return learner


@dataclass(frozen=True)
class Update:
    """A learner whose updates are measured, with the expert's transitions in its replay.

    Args:
        work: name of the row.
        experiment: task, algorithm and fields of the environment.
        network: its name and parameters.
        obs_size: pixels of the images.
        with_amx: budget of a CPU that computes in bfloat16 with AMX; None for none.
        without_amx: budget of another CPU.
    """

    work: str
    experiment: dict[str, Any]
    network: dict[str, Any]
    obs_size: int = 128
    with_amx: Budget | None = None
    without_amx: Budget | None = None


UPDATES: dict[str, list[Update]] = {
    "equi_sacfd_update": [
        Update(
            "Equi SACfD update, batch 64, 128 px, C8, 64 fields",
            CLOSE_LOOP,
            {"name": "equi", "group_order": 8, "n_hidden": 64},
            with_amx=Budget("13.5", 1.8, 1.3),
            without_amx=Budget("25.3", 9.0, 5.0),
        )
    ],
    "equi_sacfd_update_small": [  # of `make train`
        Update(
            "Equi SACfD update, batch 64, 64 px, C8, 16 fields",
            CLOSE_LOOP,
            {"name": "equi", "group_order": 8, "n_hidden": 16},
            64,
            with_amx=Budget("", None, 0.15),
        )
    ],
    "strided_sacfd_update": [
        Update(
            f"Equi SACfD update, strided, batch 64, {obs_size} px, C8, {fields} fields",
            CLOSE_LOOP,
            {"name": "equi_strided", "group_order": 8, "n_hidden": fields},
            obs_size,
        )
        for obs_size, fields in ((128, 64), (64, 16))
    ],
    "cnn_sacfd_update": [
        Update(
            "CNN SACfD update, batch 64, 128 px",
            CLOSE_LOOP,
            {"name": "cnn"},
            with_amx=Budget("1.57", 0.29, 0.2),
            without_amx=Budget("3.6", 1.0, 0.7),
        )
    ],
    "equi_sdqfd_update": [
        Update(
            "SDQfD Equi ASR update, batch 16, 128 px, 16 rotations",
            OPEN_LOOP,
            {"name": "equi_asr"},
            with_amx=Budget("40.6", 6.0, 4.0),
        )
    ],
    "cnn_sdqfd_update": [
        Update(
            "SDQfD CNN ASR update, batch 16, 128 px, 16 rotations",
            OPEN_LOOP,
            {"name": "asr"},
            with_amx=Budget("3.9", 0.75, 0.5),
        )
    ],
    "equi_deictic_sdqfd_update": [  # six degrees of freedom, images of ramps
        Update(
            "SDQfD Equi Deictic ASR update, batch 16, 128 px, 24 px in hand",
            SIX_DOF,
            {"name": "equi_deictic_asr"},
        )
    ],
}
"""The reference's learners and others, by name of the measurement."""


def measure_update(bench: Bench, update: Update) -> list[Row]:
    """Return the row of a learner's updates."""
    config = _config(bench, update.experiment, update.network, update.obs_size)
    learner = make_learner(bench, update.experiment, update.network, update.obs_size)
    dtype = network_dtype(config.network, bench.device)
    product = MatrixProduct(dtype, bench.device)
    multiply_adds = count_multiply_adds(learner.update)
    if bench.compile_mode is not None:  # after the count, in which nothing is compiled
        learner.compile(bench.compile_mode)
    times = bench.time_against(
        {"unit": LearningUnit(bench.device), "product": product}, {update.work: learner.update}
    )
    limits = [multiply_adds / product.multiply_adds * value for value in times["product"]]
    notes = f"{multiply_adds / 1e9:.3g} G multiply-adds, {product.describe(times['product'])}"
    uses_amx = amx_is_used() and dtype == torch.bfloat16
    budget = update.with_amx if uses_amx else update.without_amx
    shown = budget if bench.device.type == "cpu" else None
    return [timed_row(update.work, "s", times[update.work], times["unit"], shown, notes, limits)]


for _name, _updates in UPDATES.items():
    measurement(f"learning/{_name}", over=partial(zip, _updates))(measure_update)


ACTING = {
    "Equi SACfD, 128 px, C8, 64 fields": (
        CLOSE_LOOP,
        {"name": "equi", "group_order": 8, "n_hidden": 64},
        128,
    ),
    "Equi SACfD, 64 px, C8, 16 fields": (
        CLOSE_LOOP,
        {"name": "equi", "group_order": 8, "n_hidden": 16},
        64,
    ),
    "SDQfD Equi ASR, 128 px, 16 rotations": (OPEN_LOOP, {"name": "equi_asr"}, 128),
    "SDQfD Equi Deictic ASR, 128 px": (SIX_DOF, {"name": "equi_deictic_asr"}, 128),
}
"""Networks that act, with their experiment, parameters and size of images."""


@measurement("learning/acting", over=lambda: [(work,) for work in ACTING])
def measure_acting(bench: Bench, work: str) -> list[Row]:
    """Greedy actions of five environments, with filters expanded in every pass and once."""
    experiment, network, obs_size = ACTING[work]
    config = _config(bench, experiment, network, obs_size)
    env = make_vector_env(config.env, 5, parallel=False, seed=SEED)
    state = env.reset()
    env.close()
    act = acting_on(build_learner(config).policy, bench.device)

    @torch.no_grad()
    @set_exploration_type(ExplorationType.DETERMINISTIC)
    def every_pass() -> None:
        act(state.clone())

    with constant_weights():
        every_pass()
        kept = copy_context()
    calls = {
        f"{work}, actions of 5 environments": every_pass,
        f"{work}, actions of 5 environments, filters reused": lambda: kept.run(every_pass),
    }
    times = bench.time_against({"unit": LearningUnit(bench.device)}, calls)
    return [timed_row(call, "ms", times[call], times["unit"]) for call in calls]


def _replay_memory(
    bench: Bench, task: str, codecs: Callable[[float], dict[str, ImageCodec]], budget: Budget
) -> list[Row]:
    """Memory of the expert's episodes in the replay, scaled to the full capacity."""
    high, episodes = _expert_episodes(task, bench.repeats, {"obs_size": 128})
    storage = FrameStorage(CAPACITY, codecs(high))
    stored = 0
    for number in bench.rounds():
        data = as_transitions(episodes[number], storage.codecs, is_demonstration=True)
        storage.set(torch.arange(stored, stored + len(data)), data)
        stored += len(data)
    megabytes = storage.nbytes / stored * CAPACITY / 1e6
    notes = f"counted over {stored} transitions, {storage.nbytes / stored:.0f} bytes each"
    work = f"100,000 transitions of 128 px, {task}"
    return [Row(work, "MB", [megabytes], budget, notes=notes)]


@measurement("memory/close_loop_replay")
def close_loop_memory(bench: Bench) -> list[Row]:
    """Memory of a replay of 8-bit depth images."""
    return _replay_memory(
        bench,
        "close_loop/block_picking",
        lambda high: {keys.DEPTH: DepthQuantizer(high)},
        Budget("3300", 50.0, None),
    )


@measurement("memory/open_loop_replay")
def open_loop_memory(bench: Bench) -> list[Row]:
    """Memory of a replay of half-precision heightmaps and in-hand images."""
    return _replay_memory(
        bench,
        "open_loop/block_stacking",
        lambda high: dict.fromkeys((keys.HEIGHTMAP, keys.IN_HAND), HalfPrecision(high)),
        Budget("13000", 100.0, None),
    )
