"""Losses in bfloat16 are those in float32 within one per cent."""

import pytest
import torch

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.config import parse
from tests.algorithms.tiny import problem, spatial_problem, spatial_transitions, transitions

pytest.importorskip("escnn")

SIZES = {
    "cnn": {"width": 0.25},
    "equi": {"group_order": 8, "n_hidden": 16},
    "asr": {"num_rotations": 4, "width": 0.25},
    "equi_asr": {"num_rotations": 4, "width": 0.25},
    "fcn": {"num_rotations": 4, "width": 0.25},
    "equi_fcn": {"num_rotations": 4, "width": 0.25},
    "rot_fcn": {"num_rotations": 4, "width": 0.25},
    "equi_deictic_asr": {"num_rotations": 4, "num_z": 8, "num_tilts": 3, "width": 0.25},
}
CLOSE_LOOP = {"cnn", "equi"}


@pytest.mark.parametrize("network", SIZES)
def test_losses_in_bfloat16(network):
    losses = {}
    algorithm = "sac" if network in CLOSE_LOOP else "spatial_q"
    if network in CLOSE_LOOP:
        described = problem()
    elif network == "equi_deictic_asr":
        described = spatial_problem("pxyzrrr", channels=3)
    else:
        described = spatial_problem()
    for precision in ("float32", "bfloat16"):
        torch.manual_seed(0)
        settings = {"demonstrations": "sdqfd"} if algorithm == "spatial_q" else {}
        config = parse(ALGORITHMS[algorithm], settings, algorithm)
        sizes = parse(NETWORKS[network], {**SIZES[network], "precision": precision}, network)
        learner = config.build(sizes, described)
        data = transitions(learner) if algorithm == "sac" else spatial_transitions(learner)
        torch.manual_seed(3)  # of the sampled actions
        losses[precision] = learner.loss(data).detach()
    names = [name for name in learner.loss.out_keys if name.startswith("loss_")]
    assert len(names) > 1
    for name in names:
        exact, rough = losses["float32"][name], losses["bfloat16"][name]
        torch.testing.assert_close(rough, exact, rtol=0.01, atol=0.0)
        assert not torch.equal(rough, exact)
