"""Losses in bfloat16 are near those in float32."""

import pytest
import torch

from tests.algorithms.tiny import SIZES, build, transitions
from tests.specs import slow_except

WIDER = {**{name: {"width": 0.25} for name in SIZES}, "equi": {"group_order": 8, "n_hidden": 16}}


@pytest.mark.parametrize(
    "network", slow_except([name for name in SIZES if name != "ferm"], ["cnn", "equi_asr"])
)
def test_losses_in_bfloat16(network):
    losses = {}
    algorithm = "sac" if network in ("cnn", "equi") else "spatial_q"
    for precision in ("float32", "bfloat16"):
        learner = build(algorithm, network, sizes={**WIDER[network], "precision": precision})
        data = transitions(learner, 24 if algorithm == "sac" else 8)
        torch.manual_seed(3)  # of the sampled actions
        losses[precision] = learner.loss(data).detach()
    names = [name for name in learner.loss.out_keys if name.startswith("loss_")]
    assert len(names) > 1
    for name in names:
        exact, rough = losses["float32"][name], losses["bfloat16"][name]
        # values of the untrained deictic network nearly tie, so that rounding changes greedy
        # actions: the difference is up to seven per cent over six seeds
        rtol = 0.1 if network == "equi_deictic_asr" else 0.01
        torch.testing.assert_close(rough, exact, rtol=rtol, atol=0.0)
        assert not torch.equal(rough, exact)
