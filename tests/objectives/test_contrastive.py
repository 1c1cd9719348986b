"""The contrastive term of the SACfD loss against loops."""

import math

import pytest
import torch
from torchrl.objectives import SoftUpdate

from ba_torchrl.envs import keys
from ba_torchrl.objectives.sacfd import BilinearInfoNCE, SoftUpdateByNetwork
from tests.linear_sac import batch, make


def loop(anchors, weight, positives):
    """InfoNCE with Python floats: the cross-entropy of each anchor with its own positive."""
    losses = []
    for i, anchor in enumerate(anchors):
        similarities = [
            sum(
                anchor[m] * weight[m][n] * positive[n]
                for m in range(len(anchor))
                for n in range(len(positive))
            )
            for positive in positives
        ]
        top = max(similarities)
        log_sum = top + math.log(sum(math.exp(s - top) for s in similarities))
        losses.append(log_sum - similarities[i])
    return losses


def test_the_loss_equals_a_loop():
    torch.manual_seed(0)
    head = BilinearInfoNCE(3).double()
    assert 0 <= float(head.weight.min()) <= float(head.weight.max()) < 1
    anchors, positives = torch.randn(5, 3).double(), torch.randn(5, 3).double()
    expected = loop(anchors.tolist(), head.weight.tolist(), positives.tolist())
    assert head(anchors, positives).tolist() == pytest.approx(expected, rel=1e-9)


def with_positives(data):
    data = data.clone()
    generator = torch.Generator().manual_seed(5)
    shape = data[keys.PIXELS].shape
    data[keys.POSITIVE, keys.PIXELS] = torch.rand(shape, generator=generator, dtype=torch.float64)
    data[keys.POSITIVE, keys.HOLDING] = data[keys.HOLDING]
    return data


def features(loss, params, tree, i):
    weight = getattr(loss, params)["module", "net", "weight"].tolist()
    bias = getattr(loss, params)["module", "net", "bias"].tolist()
    x = [*tree[keys.PIXELS][i].tolist(), float(tree[keys.HOLDING][i])]
    return [
        math.tanh(sum(w * v for w, v in zip(row, x, strict=True)) + b)
        for row, b in zip(weight, bias, strict=True)
    ]


def contrastive(**settings):
    torch.manual_seed(1)
    return make(contrastive=BilinearInfoNCE(4), **settings)


def test_anchors_are_features_and_positives_those_of_the_target_encoder():
    loss, data = contrastive(), with_positives(batch())
    anchors = [features(loss, "encoder_network_params", data, i) for i in range(4)]
    positives = [
        features(loss, "target_encoder_network_params", data[keys.POSITIVE], i) for i in range(4)
    ]
    expected = loop(anchors, loss.contrastive.weight.tolist(), positives)
    out = loss.contrastive_loss(data)
    assert list(out.keys()) == ["loss_contrastive"]
    assert float(out["loss_contrastive"]) == pytest.approx(sum(expected) / 4, rel=1e-9)
    none = contrastive(reduction="none").contrastive_loss(data)["loss_contrastive"]
    assert none.tolist() == pytest.approx(expected, rel=1e-9)


def test_the_other_losses_are_those_without_it():
    expected, found = make()(batch()), contrastive()(with_positives(batch()))
    assert set(found.keys()) == set(expected.keys())
    for name in expected.keys():  # noqa: SIM118
        torch.testing.assert_close(found[name], expected[name])


def test_its_gradient_reaches_the_encoder_and_the_similarity_only():
    loss = contrastive()
    loss.contrastive_loss(with_positives(batch()))["loss_contrastive"].backward()
    reached = {n for n, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    encoder = {n for n, _ in loss.named_parameters() if n.startswith("encoder_network")}
    assert encoder
    assert reached == {*encoder, "contrastive.weight"}


def test_the_encoders_target_has_a_rate_of_its_own():
    loss = make()
    updater = SoftUpdateByNetwork(loss, tau=0.25, taus={"encoder_network": 0.5})
    assert isinstance(updater, SoftUpdate)
    rates = {"encoder_network": 0.5, "qvalue_network": 0.25}
    before = {}
    with torch.no_grad():
        for name in rates:
            for value in getattr(loss, f"{name}_params").values(True, True):
                value.add_(1.0)
            before[name] = getattr(loss, f"target_{name}_params").clone()
    updater.step()
    for name, tau in rates.items():
        online, target = getattr(loss, f"{name}_params"), getattr(loss, f"target_{name}_params")
        for key, old in before[name].items(True, True):
            torch.testing.assert_close(target[key], old + tau * (online[key].detach() - old))
