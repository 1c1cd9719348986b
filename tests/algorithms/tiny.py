"""Small learners, transitions and runs of algorithms."""

import torch
from tensordict import TensorDict

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS, Problem
from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.core.config import parse
from ba_torchrl.data.transitions import WITH_TARGET
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from tests.specs import close_loop_images, open_loop_images

SIZES = {
    "cnn": {"width": 0.25},
    "equi": {"group_order": 4, "n_hidden": 8},
    "ferm": {"width": 0.125, "features": 8},
    **{
        name: {"num_rotations": 4, "width": 0.125}
        for name in ("fcn", "equi_fcn", "rot_fcn", "asr", "equi_asr", "equi_deictic_asr")
    },
}
SIX_DOF = "pxyzrrr"
BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
PER = {"name": "prioritized"}
SO2 = {"name": "sampled"}
FERM = {"views": {"name": "shift"}, "contrastive": {"name": "info_nce"}}
"""SAC with optimisers of its own for one of the terms of the loss."""
OPEN = {"task": "open_loop/block_stacking", "env": {"obs_size": 32, "num_objects": 2}}
"""Changes of `run` for an open-loop task."""


def problem(network="cnn", sequence=None, **changes):
    """A problem of ten updates that a network can learn."""
    control = NETWORKS[network].control
    if control == "close_loop":
        images, actions = close_loop_images(64), CloseLoopActions("pxyzr")
    else:
        sequence = sequence or (SIX_DOF if network == "equi_deictic_asr" else "pxyr")
        images = open_loop_images(channels=3 if sequence == SIX_DOF else 1)
        actions = OpenLoopActions(sequence, BOUNDS)
    values = {"total_updates": 10, "seed": 0, "device": torch.device("cpu"), **changes}
    return Problem(**{"control": control, "images": images, "actions": actions, **values})


def network_config(network, sequence=None, **sizes):
    """The hyper-parameters of a small network."""
    if sequence == SIX_DOF or network == "equi_deictic_asr":
        sizes = {"num_z": 8, "num_tilts": 3, **sizes}
    return parse(NETWORKS[network], {**SIZES[network], **sizes}, network)


def build(algorithm, network="cnn", *, sequence=None, sizes=None, on=None, **settings):
    """A learner for `problem`, or for the problem ``on``."""
    on = on or problem(network, sequence)
    torch.manual_seed(on.seed)
    config = parse(ALGORITHMS[algorithm], settings, algorithm)
    return config.build(network_config(network, sequence, **(sizes or {})), on)


def transitions(learner, count=24):
    """Random transitions, every second one a demonstration; open-loop actions are on the grid."""
    generator = torch.Generator().manual_seed(1)

    def rand(*shape):
        return torch.rand(count, *shape, generator=generator)

    def state():
        images = {key: rand(*image.shape) * image.high for key, image in learner.images.items()}
        vectors = {key: rand(size) for key, size in learner.vectors.items()}
        return {**images, keys.HOLDING: rand(1) < 0.5, **vectors}

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
    if keys.STEP_COUNT in learner.policy.in_keys:  # of chunks
        size = (learner.config.horizon, learner.problem.actions.size)
        data[keys.TARGET_CHUNK] = 1.8 * rand(*size) - 0.9
        data[keys.TARGET_CHUNK_MASK] = rand(size[0]) < 0.7
        data[keys.STEP_COUNT] = torch.zeros(count, 1, dtype=torch.int64)
    data = TensorDict(data, [count])
    if learner.problem.control == "open_loop":
        low, high = torch.tensor(learner.problem.actions.ranges).T
        action = low + (high - low) * rand(len(low))
        data[keys.ACTION] = learner.nearest_action(action)
    return data


def make_experiment(folder, network, algorithm, **changes):
    """A run of two updates, each after a step of two environments."""
    units = {} if network == "asr" else {"depth_center_m": 0.2, "depth_scale_m": 0.1}
    values = {
        "task": "close_loop/block_reaching",
        "env": {"obs_size": 64, "max_steps": 6},
        "algorithm": {"batch_size": 8, "optimizer": {"learning_rate": 3e-3}, **algorithm},
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
    return experiment.learner
