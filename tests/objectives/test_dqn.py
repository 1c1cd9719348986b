import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import QValueActor

from ba_torchrl.objectives.dqn import (
    LevelDQNLoss,
    large_margin,
    strict_large_margin,
)

GAMMA = 0.95
SIZES = (7, 3)


class TwoLevels(nn.Module):
    """Linear values; those of the second level depend on the choice at the first."""

    in_keys = ("pixels", "holding")

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.first = nn.Parameter(torch.randn(4, SIZES[0], generator=generator))
        self.second = nn.Parameter(torch.randn(SIZES[0], 4, SIZES[1], generator=generator))

    def forward(self, pixels, holding, action):
        choice = action.long()
        later = torch.einsum("bi,bij->bj", pixels, self.second[choice[:, 0]])
        return [(pixels @ self.first, choice[:, 0]), (later, choice[:, 1])]

    def greedy(self, pixels, holding):
        best = (pixels @ self.first).argmax(dim=1)
        later = torch.einsum("bi,bij->bj", pixels, self.second[best])
        value, last = later.max(dim=1, keepdim=True)
        return torch.cat([best[:, None], last], dim=1), value


def batch(size=12, experts="some", seed=0):
    rng = torch.Generator().manual_seed(seed)
    flags = {
        "some": torch.rand(size, 1, generator=rng) < 0.5,
        "all": torch.ones(size, 1, dtype=torch.bool),
        "none": torch.zeros(size, 1, dtype=torch.bool),
    }[experts]
    ends = torch.rand(2, size, 1, generator=rng) < 0.3
    state = {
        "pixels": torch.randn(size, 4, generator=rng),
        "holding": torch.zeros(size, 1, dtype=torch.bool),
    }
    following = {
        "pixels": torch.randn(size, 4, generator=rng),
        "holding": torch.zeros(size, 1, dtype=torch.bool),
        "reward": torch.rand(size, 1, generator=rng),
        "terminated": ends[0],
        "truncated": ends[1] & ~ends[0],
        "done": ends[0] | ends[1],
    }
    action = torch.stack([torch.randint(n, (size,), generator=rng) for n in SIZES], dim=1).float()
    return TensorDict(
        {**state, "action": action, "is_demonstration": flags, "next": following}, batch_size=[size]
    )


def make_loss(**settings):
    loss = LevelDQNLoss(TwoLevels(), **settings).make_value_estimator(gamma=GAMMA)
    with torch.no_grad():  # a target that differs from the network
        for value in loss.target_value_network_params.values(True, True):
            value.add_(0.3 * torch.randn(value.shape, generator=torch.Generator().manual_seed(5)))
    return loss


def huber(error):
    return 0.5 * error**2 if abs(error) < 1 else abs(error) - 0.5


def by_hand(
    loss, data, kind, weight=0.1, margin=0.1, betas=(100.0, 1.0), td_weights=None, term_weights=None
):
    """The losses, computed by a loop over samples, levels and actions."""
    online = {k: loss.value_network_params[k].detach().double() for k in ("first", "second")}
    target = {k: loss.target_value_network_params[k].double() for k in ("first", "second")}
    td, priorities, terms = 0.0, [], []
    for i in range(len(data)):
        x, following = data["pixels"][i].double(), data["next", "pixels"][i].double()
        best = int((following @ target["first"]).argmax())
        value = float((following @ target["second"][best]).max())
        alive = 0.0 if data["next", "terminated"][i] else 1.0
        y = float(data["next", "reward"][i]) + GAMMA * alive * value
        choices = [int(a) for a in data["action"][i]]
        q = [
            (x @ online["first"]).tolist(),
            (x @ online["second"][choices[0]]).tolist(),
        ]
        share = 1.0 if td_weights is None else td_weights[i]
        errors = [values[choice] - y for values, choice in zip(q, choices, strict=True)]
        td += share * sum(map(huber, errors)) / len(data)
        priorities.append(sum(map(abs, errors)) / 2)
        sample = 0.0
        for level, (values, choice) in enumerate(zip(q, choices, strict=True)):
            if not data["is_demonstration"][i]:
                continue
            if kind == "sdqfd":
                gaps = [
                    v - values[choice] + margin
                    for a, v in enumerate(values)
                    if a != choice and v > values[choice] - margin
                ]
                sample += sum(gaps) / len(gaps) if gaps else 0.0
            elif kind == "dqfd":
                raised = [v + (margin if a != choice else 0) for a, v in enumerate(values)]
                sample += max(raised) - values[choice]
            elif kind == "adet":
                scaled = [betas[level] * v for v in values]
                top = max(scaled)
                log_sum = top + math.log(sum(math.exp(s - top) for s in scaled))
                sample += log_sum - scaled[choice]
        terms.append(sample if term_weights is None else term_weights[i] * sample)
    experts = int(data["is_demonstration"].sum())
    count = len(data) if kind == "sdqfd" else max(experts, 1)
    return td, weight * sum(terms) / count, priorities


@pytest.mark.parametrize("experts", ["some", "all", "none"])
@pytest.mark.parametrize("kind", ["none", "dqfd", "sdqfd", "adet"])
def test_the_losses_equal_a_loop_written_from_the_formulas(kind, experts):
    data = batch(experts=experts)
    loss = make_loss(demonstrations=kind)
    td, demonstration, priorities = by_hand(loss, data, kind)
    out = loss(data)
    assert float(out["loss_qvalue"].detach()) == pytest.approx(td, rel=1e-5)
    expected = 0.0 if kind == "none" else demonstration
    assert float(out["loss_demonstration"].detach()) == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert data["td_error"].squeeze(-1).tolist() == pytest.approx(priorities, rel=1e-5)
    assert not out["demonstration_error"].requires_grad


@pytest.mark.parametrize("kind", ["dqfd", "sdqfd", "adet"])
@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("terms", ["none", "critic", "critic_and_policy", "all"])
def test_importance_weights_multiply_the_chosen_terms(terms, norm, kind):
    data = batch()
    drawn = [0.1 + 0.05 * i for i in range(len(data))]
    data["priority_weight"] = torch.tensor(drawn)
    divisor = max(drawn) if norm == "max" else sum(drawn) / len(drawn)
    weights = [weight / divisor for weight in drawn]
    loss = make_loss(demonstrations=kind, weighted_terms=terms, weight_norm=norm)
    td, demonstration, _ = by_hand(
        loss,
        data,
        kind,
        td_weights=None if terms == "none" else weights,
        term_weights=weights if terms == "all" else None,
    )
    out = loss(data)
    assert float(out["loss_qvalue"].detach()) == pytest.approx(td, rel=1e-5)
    assert float(out["loss_demonstration"].detach()) == pytest.approx(demonstration, rel=1e-5)


def test_the_strict_margin_is_zero_without_a_violating_action():
    q = torch.tensor([[0.0, 1.0, 0.3], [0.5, 0.2, 0.55]], requires_grad=True)
    values = strict_large_margin(q, torch.tensor([1, 2]), margin=0.1)
    values[0].backward()
    assert values[0] == 0
    assert not q.grad.any()


def test_the_strict_margin_has_gradients_for_every_violation():
    # expert's 0.5: 0.45 and 0.9 violate a margin of 0.1, by 0.05 and 0.5; 0.4 just not
    q = torch.tensor([[0.5, 0.45, 0.9, 0.39999], [9.0, 0.0, 0.0, 0.0]], requires_grad=True)
    values = strict_large_margin(q, torch.tensor([0, 1]), margin=0.1)
    assert values[0].item() == pytest.approx((0.05 + 0.5) / 2, rel=1e-4)
    values[0].backward()
    assert q.grad[0].tolist() == pytest.approx([-1.0, 0.5, 0.5, 0.0])
    assert not q.grad[1].any()


@pytest.mark.parametrize("margin", [0.0, 0.1, 3.0])
def test_the_strict_margin_equals_a_loop_over_actions(margin):
    q = torch.randn(5, 40, dtype=torch.float64)
    q[4] = q[4].round()  # equal values
    chosen = torch.randint(40, (5,))
    expected = []
    for values, best in zip(q.tolist(), chosen.tolist(), strict=True):
        others = [v for index, v in enumerate(values) if index != best]
        violations = [v - values[best] + margin for v in others if v > values[best] - margin]
        expected.append(sum(violations) / max(len(violations), 1))
    assert strict_large_margin(q, chosen, margin).tolist() == pytest.approx(expected)


def test_the_margin_of_dqfd_has_gradients_for_the_worst_violation():
    q = torch.tensor([[0.5, 0.45, 0.9], [9.0, 0.0, 0.0]], requires_grad=True)
    values = large_margin(q, torch.tensor([0, 1]), margin=0.1)
    assert values[0].item() == pytest.approx(0.5)
    values[0].backward()
    assert q.grad[0].tolist() == pytest.approx([-1.0, 0.0, 1.0])


def test_the_target_network_gets_no_gradient_and_the_network_does():
    loss = make_loss()
    out = loss(batch())
    (out["loss_qvalue"] + out["loss_demonstration"]).backward()
    for parameter in loss.parameters():
        assert parameter.grad is not None
        assert parameter.grad.any()
    assert not any(v.requires_grad for v in loss.target_value_network_params.values(True, True))


def test_only_plain_dqn_works_without_the_expert_flag():
    data = batch().exclude("is_demonstration")
    loss = make_loss(demonstrations="none")
    assert "is_demonstration" not in loss.in_keys
    assert loss(data)["loss_demonstration"] == 0
    other = make_loss()
    assert "is_demonstration" in other.in_keys
    with pytest.raises(KeyError, match="is_demonstration"):
        other(data)


def test_keys_can_be_renamed():
    data = batch()
    expected = make_loss()(data.clone())["loss_qvalue"].detach()
    loss = make_loss()
    loss.set_keys(action="move", reward="gain", priority="surprise")
    data.rename_key_("action", "move")
    data["next"].rename_key_("reward", "gain")
    assert torch.equal(loss(data)["loss_qvalue"].detach(), expected)
    assert "surprise" in data


@pytest.mark.parametrize("demonstrations", ["none", "dqfd", "sdqfd", "adet"])
def test_reductions_are_the_losses_of_samples_their_mean_and_their_sum(demonstrations):
    data, found = batch(experts="all"), {}
    for reduction in ("none", "mean", "sum"):
        loss = make_loss(demonstrations=demonstrations, reduction=reduction)
        found[reduction] = loss(data.clone())
    for name in ("loss_qvalue", "loss_demonstration"):
        losses = found["none"][name]
        assert losses.shape == (12,)
        torch.testing.assert_close(found["mean"][name], losses.mean())
        torch.testing.assert_close(found["sum"][name], losses.sum())
    for name in ("demonstration_error", "td_error"):
        assert torch.equal(found["none"][name], found["mean"][name])


@pytest.mark.parametrize("demonstrations", ["dqfd", "sdqfd", "adet"])
def test_samples_that_are_not_demonstrations_have_no_demonstration_loss(demonstrations):
    data = batch()
    is_demonstration = data["is_demonstration"][:, 0]
    assert 0 < is_demonstration.sum() < len(data)

    def of(reduction):
        torch.manual_seed(0)
        loss = make_loss(demonstrations=demonstrations, margin=2.0, reduction=reduction)
        return loss(data.clone())["loss_demonstration"].detach()

    losses = of("none")
    assert (losses[~is_demonstration] == 0).all()
    assert (losses[is_demonstration] > 0).all()
    share = len(data) if demonstrations == "sdqfd" else is_demonstration.sum()
    torch.testing.assert_close(of("mean"), losses.sum() / share)


@pytest.mark.parametrize("action_space", ["one_hot", "categorical"])
def test_a_q_value_actor_of_torchrl_is_one_level(action_space):
    torch.manual_seed(0)
    network = nn.Linear(4, 5)
    actor = QValueActor(network, in_keys=["pixels"], action_space=action_space)
    data = batch().exclude("holding", ("next", "holding"))
    index = torch.randint(5, (12,))
    data["action"] = nn.functional.one_hot(index, 5) if action_space == "one_hot" else index
    loss = LevelDQNLoss(actor, demonstrations="sdqfd", margin=0.3).make_value_estimator(gamma=GAMMA)
    found = loss(data)
    with torch.no_grad():
        q = network(data["pixels"])
        best = network(data["next", "pixels"]).max(dim=1, keepdim=True).values
        target = data["next", "reward"] + GAMMA * ~data["next", "terminated"] * best
        wanted = nn.functional.huber_loss(q.gather(1, index[:, None]), target)
        margin = (strict_large_margin(q, index, 0.3) * data["is_demonstration"][:, 0]).mean()
    torch.testing.assert_close(found["loss_qvalue"], wanted)
    torch.testing.assert_close(found["demonstration_error"], margin)
    (found["loss_qvalue"] + found["loss_demonstration"]).backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters())
