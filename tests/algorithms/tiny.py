"""Small learners, transitions and runs of algorithms."""

import torch
from tensordict import TensorDict

from ba_torchrl.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS, Problem
from ba_torchrl.config import parse
from ba_torchrl.data.transitions import WITH_TARGET
from ba_torchrl.envs import keys
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from tests.specs import close_loop_images, open_loop_images

SIZES = {
    "cnn": {"width": 0.25},
    "equi": {"group_order": 4, "n_hidden": 8},
    "ferm": {"width": 0.125, "features": 8},
    "asr": {"num_rotations": 4, "width": 0.125},
}
FERM = {"view_transform": "shift", "contrastive_weight": 1.0}
"""SAC with optimisers of its own for one of the terms of the loss."""
OPEN = {"task": "open_loop/block_stacking", "env": {"obs_size": 32, "num_objects": 2}}
"""Changes of `run` for an open-loop task."""


def problem():
    """A close-loop problem of ten updates."""
    return Problem(
        control="close_loop",
        images=close_loop_images(64),
        actions=CloseLoopActions("pxyzr"),
        total_updates=10,
        seed=0,
        device=torch.device("cpu"),
    )


def spatial_problem(sequence="pxyr", channels=1):
    """An open-loop problem of ten updates, whose in-hand image has ``channels`` channels."""
    return Problem(
        control="open_loop",
        images=open_loop_images(channels=channels),
        actions=OpenLoopActions(sequence, ((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25))),
        total_updates=10,
        seed=0,
        device=torch.device("cpu"),
    )


def build(algorithm, network="cnn", **settings):
    """A learner for `problem` or, with a network of the open loop, `spatial_problem`."""
    torch.manual_seed(0)
    config = parse(ALGORITHMS[algorithm], settings, algorithm)
    spec = parse(NETWORKS[network], SIZES[network], network)
    return config.build(spec, problem() if spec.control == "close_loop" else spatial_problem())


def transitions(learner, count=24):
    """Random transitions, every second one a demonstration."""
    generator = torch.Generator().manual_seed(1)

    def rand(*shape):
        return torch.rand(count, *shape, generator=generator)

    def state():
        images = {key: rand(*image.shape) * image.high for key, image in learner.images.items()}
        return {**images, keys.HOLDING: rand(1) < 0.5}

    ended = torch.zeros(count, 1, dtype=torch.bool)
    following = {
        **state(),
        keys.REWARD: rand(1),
        **{key: ended.clone() for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
    }
    action = 1.8 * rand(learner.problem.actions.size) - 0.9
    data = {
        **state(),
        keys.ACTION: action,
        **({keys.TARGET_ACTION: -action / 2} if learner.config.imitates in WITH_TARGET else {}),
        keys.IS_DEMONSTRATION: torch.arange(count)[:, None] % 2 == 0,
        keys.NEXT: following,
    }
    return TensorDict(data, [count])


def spatial_transitions(learner, count=8):
    """As `transitions`, with actions of the learner's grid."""
    data = transitions(learner, count)
    generator = torch.Generator().manual_seed(2)
    low, high = torch.tensor(learner.problem.actions.ranges).T
    action = low + (high - low) * torch.rand(count, len(low), generator=generator)
    data[keys.ACTION] = learner.nearest_action(action)
    return data


def make_experiment(folder, network, algorithm, **changes):
    """A run of two updates, each after a step of two environments."""
    units = {} if network == "asr" else {"depth_center_m": 0.2, "depth_scale_m": 0.1}
    values = {
        "task": "close_loop/block_reaching",
        "env": {"obs_size": 64, "max_steps": 6},
        "algorithm": {"batch_size": 8, "learning_rate": 3e-3, **algorithm},
        "network": {"name": network, **SIZES[network], **units},
        "num_envs": 2,
        "parallel": False,
        "demonstrations": 4,
        "total_updates": 2,
        "min_replay": 1,
        "eval_every": 2,
        "eval_episodes": 2,
        "final_eval_episodes": 2,
        "log_every": 1,
        "video_episodes": 0,
        "run_dir": str(folder / "run"),
        **changes,
    }
    return Experiment(ExperimentConfig.parse(values), progress=False)


def run(folder, network, algorithm, **changes):
    """The learner after `make_experiment`'s run."""
    experiment = make_experiment(folder, network, algorithm, **changes)
    assert experiment.run().updates == experiment.config.total_updates
    return experiment.algorithm
