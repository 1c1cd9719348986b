import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from ba_torchrl.objectives.dqn import (
    LevelDQNLoss,
    cross_entropy,
    large_margin,
    strict_large_margin,
)

GAMMA = 0.95
SIZES = (7, 3)


class TwoLevels(nn.Module):
    """Linear values; the second level's depend on the choice at the first."""

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
        {**state, "action": action, "is_expert": flags, "next": following}, batch_size=[size]
    )


def make_loss(**settings):
    loss = LevelDQNLoss(TwoLevels(), **settings).make_value_estimator(gamma=GAMMA)
    with torch.no_grad():  # a target that differs from the network
        for value in loss.target_value_network_params.values(True, True):
            value.add_(0.3 * torch.randn(value.shape, generator=torch.Generator().manual_seed(5)))
    return loss


def huber(error):
    return 0.5 * error**2 if abs(error) < 1 else abs(error) - 0.5


def by_hand(loss, data, kind, weight=0.1, margin=0.1, betas=(100.0, 1.0), importance=None):
    """The losses by a loop over samples, levels and actions."""
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
        share = 1.0 if importance is None else importance[i] / max(importance)
        errors = [values[choice] - y for values, choice in zip(q, choices, strict=True)]
        td += share * sum(map(huber, errors)) / len(data)
        priorities.append(sum(map(abs, errors)) / 2)
        sample = 0.0
        for level, (values, choice) in enumerate(zip(q, choices, strict=True)):
            if not data["is_expert"][i]:
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
        terms.append(sample)
    experts = int(data["is_expert"].sum())
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


def test_importance_weights_are_applied_divided_by_their_largest():
    data = batch()
    weights = [0.1 + 0.05 * i for i in range(len(data))]
    data["priority_weight"] = torch.tensor(weights)
    loss = make_loss()
    td, demonstration, _ = by_hand(loss, data, "sdqfd", importance=weights)
    out = loss(data)
    assert float(out["loss_qvalue"].detach()) == pytest.approx(td, rel=1e-5)
    assert float(out["loss_demonstration"].detach()) == pytest.approx(demonstration, rel=1e-5)


def test_without_a_violating_action_the_strict_margin_is_zero_and_pulls_at_nothing():
    q = torch.tensor([[0.0, 1.0, 0.3], [0.5, 0.2, 0.55]], requires_grad=True)
    chosen, experts = torch.tensor([1, 2]), torch.tensor([True, False])
    value = strict_large_margin(q, chosen, experts, margin=0.1)
    value.backward()
    assert value == 0
    assert not q.grad.any()


def test_the_strict_margin_presses_on_every_violation_and_counts_the_whole_batch():
    # expert's 0.5: 0.45 and 0.9 violate a margin of 0.1, by 0.05 and 0.5; 0.4 just not
    q = torch.tensor([[0.5, 0.45, 0.9, 0.39999], [9.0, 0.0, 0.0, 0.0]], requires_grad=True)
    chosen = torch.tensor([0, 1])
    value = strict_large_margin(q, chosen, torch.tensor([True, False]), margin=0.1)
    assert value.item() == pytest.approx((0.05 + 0.5) / 2 / 2, rel=1e-4)
    value.backward()
    assert q.grad[0].tolist() == pytest.approx([-0.5, 0.25, 0.25, 0.0])
    assert not q.grad[1].any()


def test_the_margin_of_dqfd_presses_on_the_worst_violation_of_experts_alone():
    q = torch.tensor([[0.5, 0.45, 0.9], [9.0, 0.0, 0.0]], requires_grad=True)
    value = large_margin(q, torch.tensor([0, 1]), torch.tensor([True, False]), margin=0.1)
    assert value.item() == pytest.approx(0.5)
    value.backward()
    assert q.grad[0].tolist() == pytest.approx([-1.0, 0.0, 1.0])


def test_cross_entropy_of_even_values_is_the_logarithm_of_their_number():
    value = cross_entropy(
        torch.zeros(2, 5), torch.tensor([0, 3]), torch.tensor([True, True]), beta=100.0
    )
    assert value.item() == pytest.approx(math.log(5))


def test_a_truncated_step_bootstraps_and_a_terminated_one_does_not():
    data = batch(size=2)
    data["next", "reward"] = torch.ones(2, 1)
    data["next", "terminated"] = torch.tensor([[True], [False]])
    data["next", "truncated"] = torch.tensor([[False], [True]])
    data["next", "done"] = torch.ones(2, 1, dtype=torch.bool)
    loss = make_loss()
    target = loss._target(data)
    assert target[0].item() == 1
    assert target[1].item() != 1


def test_the_target_network_gets_no_gradient_and_the_network_does():
    loss = make_loss()
    out = loss(batch())
    (out["loss_qvalue"] + out["loss_demonstration"]).backward()
    for parameter in loss.parameters():
        assert parameter.grad is not None
        assert parameter.grad.any()
    assert not any(v.requires_grad for v in loss.target_value_network_params.values(True, True))


def test_plain_dqn_does_without_the_expert_flag_and_others_say_what_is_missing():
    data = batch().exclude("is_expert")
    loss = make_loss(demonstrations="none")
    assert "is_expert" not in loss.in_keys
    assert loss(data)["loss_demonstration"] == 0
    other = make_loss()
    assert "is_expert" in other.in_keys
    with pytest.raises(KeyError, match="is_expert"):
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
