"""The losses on levels of choices, compared with loops over samples, levels and choices."""

import itertools
import math
import statistics

import pytest
import torch
from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from ba_torchrl.modules.spatial.policy import SpatialValues
from ba_torchrl.objectives.dqn import LevelDQNLoss, large_margin, strict_large_margin
from tests.level_tables import ACTIONS, COUNTS, Tables, batch

GAMMA = 0.9
KINDS = ["dqfd", "sdqfd", "adet"]


def make_loss(**settings):
    values = SpatialValues(Tables(), ACTIONS)
    loss = LevelDQNLoss(values, **{"demonstration_weight": 0.2, "margin": 0.3, **settings})
    loss = loss.make_value_estimator(gamma=GAMMA)
    with torch.no_grad():  # a target that differs from the network
        for value in loss.target_value_network_params.values(True, True):
            value.add_(0.5 * torch.randn(value.shape, generator=torch.Generator().manual_seed(5)))
    return loss


def lookup(params, level, state, index, chosen):
    """Return {choice: value} of a level, given the choices before it."""
    table = params["network", "tables", str(level)].detach().double()
    scale = float(state["heightmap"][index].double().mean())
    row = table[int(state["holding"][index])]
    for choice in chosen:
        row = row[choice]
    sizes = COUNTS[:2] if level == 0 else (COUNTS[level + 1],)
    return {choice: float(row[choice]) * scale for choice in itertools.product(*map(range, sizes))}


def demonstration_term(kind, q, taken, level):
    if kind == "sdqfd":
        gaps = [v - q[taken] + 0.3 for a, v in q.items() if a != taken and v > q[taken] - 0.3]
        return sum(gaps) / len(gaps) if gaps else 0.0
    if kind == "dqfd":
        return max(v + 0.3 * (a != taken) for a, v in q.items()) - q[taken]
    beta = 100.0 if level == 0 else 1.0
    top = max(q.values())
    total = sum(math.exp(beta * (v - top)) for v in q.values())
    return beta * (top - q[taken]) + math.log(total)


def by_hand(loss, data, kind, td_weights=None, term_weights=None):
    """The two losses and the priorities, by a loop over samples, levels and choices."""
    ones = [1.0] * len(data)
    td_weights, term_weights = td_weights or ones, term_weights or ones
    td, term, priorities = 0.0, 0.0, []
    for i, choices in enumerate(data["chosen"].tolist()):
        greedy, target = (), loss.target_value_network_params
        chooser = loss.value_network_params if loss.double_dqn else target
        for level in range(5):  # the greedy choices, each given those before
            following = lookup(chooser, level, data["next"], i, greedy)
            best = max(following, key=following.get)
            last = lookup(target, level, data["next"], i, greedy)[best]
            greedy += best
        alive = not data["next", "terminated"][i]
        y = float(data["next", "reward"][i]) + GAMMA * alive * last
        errors = []
        for level in range(5):  # the stored choices, each given those before
            before = choices[: level + 1] if level else []
            q = lookup(loss.value_network_params, level, data, i, before)
            taken = tuple(choices[:2]) if level == 0 else (choices[level + 1],)
            errors.append(abs(q[taken] - y))
            huber = 0.5 * errors[-1] ** 2 if errors[-1] < 1 else errors[-1] - 0.5
            td += td_weights[i] * huber
            if data["is_demonstration"][i] and kind != "none":
                term += term_weights[i] * demonstration_term(kind, q, taken, level)
        priorities.append(sum(errors) / 5)
    count = len(data) if kind == "sdqfd" else max(int(data["is_demonstration"].sum()), 1)
    return td / len(data), 0.2 * term / count, priorities


@pytest.mark.parametrize("experts", ["some", "all", "none"])
@pytest.mark.parametrize("kind", ["none", *KINDS, "double"])
def test_the_losses_equal_a_loop_written_from_the_formulas(kind, experts):
    kind, is_double = ("none", True) if kind == "double" else (kind, False)
    data, loss = batch(experts=experts), make_loss(demonstrations=kind, double_dqn=is_double)
    td, demonstration, priorities = by_hand(loss, data, kind)
    out = loss(data)
    assert float(out["loss_qvalue"].detach()) == pytest.approx(td, rel=1e-5)
    assert float(out["loss_demonstration"].detach()) == pytest.approx(demonstration, rel=1e-4)
    assert data["td_error"].squeeze(-1).tolist() == pytest.approx(priorities, rel=1e-5)
    assert not out["demonstration_error"].requires_grad
    (out["loss_qvalue"] + out["loss_demonstration"]).backward()
    assert all(parameter.grad.any() for parameter in loss.parameters())
    assert not any(v.requires_grad for v in loss.target_value_network_params.values(True, True))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("terms", ["none", "critic", "critic_and_policy", "all"])
def test_importance_weights_multiply_the_chosen_terms(terms, norm, kind):
    data = batch()
    drawn = [0.1 + 0.05 * i for i in range(len(data))]
    data["priority_weight"] = torch.tensor(drawn)
    is_demonstration = data["is_demonstration"][:, 0].tolist()
    counted = [
        w for w, flag in zip(drawn, is_demonstration, strict=True) if flag or kind == "sdqfd"
    ]
    divisors = [max(drawn) if norm == "max" else statistics.mean(w) for w in (drawn, counted)]
    of_td, of_term = ([weight / divisor for weight in drawn] for divisor in divisors)
    loss = make_loss(demonstrations=kind, weighted_terms=terms, weight_norm=norm)
    chosen = None if terms == "none" else of_td, of_term if terms == "all" else None
    td, demonstration, _ = by_hand(loss, data, kind, *chosen)
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


@pytest.mark.parametrize("demonstrations", KINDS)
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


def q_value_actor(action_space="categorical"):
    """An actor of TorchRL with five actions, and a batch for it."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Flatten(), nn.Linear(9, 5))
    actor = QValueActor(network, in_keys=["heightmap"], action_space=action_space)
    data = batch().select("heightmap", "is_demonstration", "next")
    index = torch.randint(5, (10,))
    data["action"] = nn.functional.one_hot(index, 5) if action_space == "one_hot" else index
    return network, actor, data, index


@pytest.mark.parametrize("uses_weights", ["auto", True, False])
@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("double_dqn", [False, True])
def test_without_demonstrations_the_loss_is_torchrls(
    double_dqn, reduction, is_masked, uses_weights
):
    _, actor, data, _ = q_value_actor()
    data["next", "reward"] *= 3
    data["priority_weight"] = torch.linspace(0.1, 1, 10)
    if is_masked:
        data["collector", "mask"] = torch.arange(10)[:, None] % 3 > 0
    options = {"reduction": reduction, "use_prioritized_weights": uses_weights}
    options["double_dqn"] = double_dqn
    ours = LevelDQNLoss(actor, demonstrations="none", **options)
    theirs = DQNLoss(actor, loss_function="smooth_l1", action_space="categorical", **options)
    for loss in (ours, theirs):
        loss.make_value_estimator(gamma=GAMMA)
        SoftUpdate(loss, tau=0.1)
        for value in loss.target_value_network_params.values(True, True):
            value.mul_(-0.5)  # another action is the greedy one
    expected = theirs(data.clone())["loss"]
    torch.testing.assert_close(ours(data)["loss_qvalue"], expected)


@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("kind", ["none", *KINDS])
def test_masked_samples_do_not_count(kind, norm):
    data, options = batch(), {"weighted_terms": "all", "weight_norm": norm}
    data["priority_weight"] = torch.linspace(0.1, 1, 10)
    mask = torch.arange(10) % 4 > 0
    expected = make_loss(demonstrations=kind, **options)(data[mask])
    data["collector", "mask"] = mask[:, None]
    data["next", "reward"][~mask] = torch.nan
    found = make_loss(demonstrations=kind, **options)(data)
    torch.testing.assert_close(dict(found), dict(expected))


@pytest.mark.parametrize("norm", ["max", "mean"])
def test_without_samples_that_count_loss_and_gradient_are_zero(norm):
    loss = make_loss(demonstrations="sdqfd", weighted_terms="all", weight_norm=norm)
    data = batch()
    data["priority_weight"] = torch.linspace(0, 1, 10)
    for none in (data[:1], data.set(("collector", "mask"), torch.zeros(10, 1).bool())):
        losses = loss(none)
        total = losses["loss_qvalue"] + losses["loss_demonstration"]
        total.backward()
        assert total == 0
        assert not any(value.grad.any() for value in loss.parameters() if value.grad is not None)


@pytest.mark.parametrize("action_space", ["one_hot", "categorical"])
def test_a_q_value_actor_of_torchrl_is_one_level(action_space):
    network, actor, data, index = q_value_actor(action_space)
    loss = LevelDQNLoss(actor, demonstrations="sdqfd", margin=0.3).make_value_estimator(gamma=GAMMA)
    found = loss(data)
    with torch.no_grad():
        q = network(data["heightmap"])
        best = network(data["next", "heightmap"]).max(dim=1, keepdim=True).values
        target = data["next", "reward"] + GAMMA * ~data["next", "terminated"] * best
        wanted = nn.functional.huber_loss(q.gather(1, index[:, None]), target)
        margin = (strict_large_margin(q, index, 0.3) * data["is_demonstration"][:, 0]).mean()
    torch.testing.assert_close(found["loss_qvalue"], wanted)
    torch.testing.assert_close(found["demonstration_error"], margin)
    (found["loss_qvalue"] + found["loss_demonstration"]).backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters())
