"""Losses in bfloat16 are those in float32 within one per cent."""

import pytest
import torch

from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS, Problem
from ba_torchrl.config import parse
from ba_torchrl.envs import keys
from tests.algorithms.tiny import problem, transitions
from tests.specs import open_loop_images

pytest.importorskip("escnn")

BOUNDS = ((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25))
SIZES = {
    "cnn": {"width": 0.25},
    "equi": {"group_order": 8, "n_hidden": 16},
    "asr": {"num_rotations": 4, "width": 0.25},
    "equi_asr": {"num_rotations": 4, "width": 0.25},
}


def spatial_problem():
    return Problem(
        control="open_loop",
        images=open_loop_images(),
        actions=OpenLoopActions("pxyr", BOUNDS),
        total_updates=10,
        seed=0,
        device=torch.device("cpu"),
    )


def spatial_transitions(learner):
    """Random images with demonstrated actions of the grid."""
    data = transitions(learner, 8)
    rng = torch.Generator().manual_seed(2)
    low, high = torch.tensor(learner.problem.actions.ranges).T
    action = low + (high - low) * torch.rand(8, len(low), generator=rng)
    data[keys.ACTION] = learner.nearest_action(action)
    return data


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("algorithm", "network"),
    [("sac", "cnn"), ("sac", "equi"), ("spatial_q", "asr"), ("spatial_q", "equi_asr")],
)
def test_losses_in_bfloat16(algorithm, network, seed):
    losses = {}
    for precision in ("float32", "bfloat16"):
        torch.manual_seed(seed)
        settings = {"demonstrations": "sdqfd"} if algorithm == "spatial_q" else {}
        config = parse(ALGORITHMS[algorithm], settings, algorithm)
        sizes = parse(NETWORKS[network], {**SIZES[network], "precision": precision}, network)
        learner = config.build(sizes, problem() if algorithm == "sac" else spatial_problem())
        data = transitions(learner) if algorithm == "sac" else spatial_transitions(learner)
        torch.manual_seed(3)  # of the sampled actions
        losses[precision] = learner.loss(data).detach()
    names = [name for name in learner.loss.out_keys if name.startswith("loss_")]
    assert len(names) > 1
    for name in names:
        exact, rough = losses["float32"][name], losses["bfloat16"][name]
        torch.testing.assert_close(rough, exact, rtol=0.01, atol=0.0)
        assert not torch.equal(rough, exact)
