"""The SACfD loss against plain arithmetic, and against TorchRL's contract."""

import math

import pytest
import torch
from torchrl.objectives import SoftUpdate, ValueEstimators

from ba_torchrl.envs import keys
from tests.linear_sac import (
    batch,
    make,
)


def affine(row_weights, bias, x):
    return [
        sum(w * v for w, v in zip(row, x, strict=True)) + b
        for row, b in zip(row_weights, bias, strict=True)
    ]


def importance(data, terms, norm):
    """Weights of the critic's, the policy's and the other terms of each sample."""
    ones = [1.0] * len(data)
    weights = data["priority_weight"].tolist() if "priority_weight" in data else ones
    divisor = max(weights) if norm == "max" else sum(weights) / len(weights)
    weights = [w / divisor for w in weights]
    number = ["none", "critic", "critic_and_policy", "all"].index(terms)
    return [weights if number >= least else ones for least in (1, 2, 3)]


def by_hand(
    loss,
    data,
    gamma,
    alpha,
    target_entropy,
    demonstration_weight,
    terms="critic_and_policy",
    norm="max",
    entropy_backup=True,
):
    """The terms of the loss, computed with Python floats and loops."""

    def parameters(name):
        tree = getattr(loss, name)
        return tree["module", "net", "weight"].tolist(), tree["module", "net", "bias"].tolist()

    actor_tree = loss.actor_network_params["module", "0", "module"]
    actor = actor_tree["net", "weight"].tolist(), actor_tree["net", "bias"].tolist()
    log_std = actor_tree["log_std"].tolist()

    def policy(x):
        action = [math.tanh(v) for v in affine(*actor, x)]
        return action, (sum(action) + sum(log_std)) / 2

    def q(x, action, prefix):
        encoder = parameters(f"{prefix}encoder_network_params")
        features = [math.tanh(v) for v in affine(*encoder, x)]
        return affine(*parameters(f"{prefix}qvalue_network_params"), features + action)

    def observation(tree, i):
        return [*tree[keys.PIXELS][i].tolist(), float(tree[keys.HOLDING][i])]

    n = len(data)
    critic, policy_weights, others = importance(data, terms, norm)
    qvalue = actor_term = alpha_term = entropy = value = behaviour = weighted_behaviour = 0.0
    experts, priorities = 0, []
    for i in range(n):
        x, following = observation(data, i), observation(data[keys.NEXT], i)
        stored = data[keys.ACTION][i].tolist()
        next_action, next_log_prob = policy(following)
        bootstrap = min(q(following, next_action, "target_"))
        bootstrap -= alpha * next_log_prob * entropy_backup
        y = float(data[keys.NEXT, keys.REWARD][i])
        if not data[keys.NEXT, keys.TERMINATED][i]:
            y += gamma * bootstrap
        errors = [v - y for v in q(x, stored, "")]
        qvalue += critic[i] * sum(e * e for e in errors) / n
        value += sum(q(x, stored, "")) / 2 / n
        priorities.append([sum(abs(e) for e in errors) / 2])
        action, log_prob = policy(x)
        actor_term += policy_weights[i] * (alpha * log_prob - min(q(x, action, ""))) / n
        alpha_term -= others[i] * math.log(alpha) * (log_prob + target_entropy) / n
        entropy -= log_prob / n
        if keys.IS_DEMONSTRATION in data and data[keys.IS_DEMONSTRATION][i]:
            experts += 1
            error = sum((a - e) ** 2 for a, e in zip(action, stored, strict=True)) / 2
            behaviour += error
            weighted_behaviour += others[i] * error
    behaviour /= max(experts, 1)
    weighted_behaviour /= max(experts, 1)
    return {
        "loss_qvalue": qvalue,
        "loss_actor": actor_term + demonstration_weight * weighted_behaviour,
        "loss_alpha": alpha_term,
        "alpha": alpha,
        "entropy": entropy,
        "demonstration_error": behaviour,
        "q_value": value,
    }, priorities


@pytest.mark.parametrize("weights", [(0.2, 0.8, 0.4, 0.1), None], ids=["weights", "uniform"])
@pytest.mark.parametrize("experts", [(True, False, True, False), (False,) * 4, (True,) * 4])
@pytest.mark.parametrize("demonstration_weight", [1.0, 0.3])
def test_losses_equal_a_calculation_in_python(experts, weights, demonstration_weight):
    loss = make(
        alpha_init=0.2, target_entropy=-1.5, demonstration_weight=demonstration_weight
    ).make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    data = batch(experts, weights)
    expected, priorities = by_hand(loss, data, 0.9, 0.2, -1.5, demonstration_weight)
    out = loss(data)
    assert set(out.keys()) == set(loss.out_keys) == set(expected)
    for name, value in expected.items():
        assert out[name].item() == pytest.approx(value, rel=1e-6), name
    assert data[keys.TD_ERROR].shape == (4, 1)
    expected_priorities = torch.tensor(priorities, dtype=torch.float64)
    torch.testing.assert_close(data[keys.TD_ERROR], expected_priorities, rtol=1e-6, atol=0)


@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("terms", ["none", "critic", "critic_and_policy", "all"])
def test_importance_weights_multiply_the_chosen_terms(terms, norm):
    loss = make(alpha_init=0.2, target_entropy=-1.5, weighted_terms=terms, weight_norm=norm)
    data = batch()
    expected, _ = by_hand(loss, data, 0.99, 0.2, -1.5, 1.0, terms, norm)
    out = loss(data)
    for name, value in expected.items():
        assert out[name].item() == pytest.approx(value, rel=1e-6), name


def test_without_entropy_backup_the_target_is_the_return_alone():
    data = batch()
    losses = {}
    for backup in (True, False):
        loss = make(alpha_init=0.2, target_entropy=-1.5, entropy_backup=backup)
        expected, _ = by_hand(loss, data, 0.99, 0.2, -1.5, 1.0, entropy_backup=backup)
        out = loss(data)
        for name, value in expected.items():
            assert out[name].item() == pytest.approx(value, rel=1e-6), name
        losses[backup] = out["loss_qvalue"].item()
    assert losses[True] != pytest.approx(losses[False], rel=1e-3)


def test_defaults_are_those_of_the_appendix():
    loss = make()
    assert float(loss.value_estimator.gamma) == pytest.approx(0.99)
    assert float(loss.alpha) == pytest.approx(0.01)
    assert float(loss.target_entropy) == -5
    data = batch()
    expected, _ = by_hand(loss, data, 0.99, 0.01, -5, 1)
    assert float(loss(data)["loss_qvalue"]) == pytest.approx(expected["loss_qvalue"], rel=1e-6)


def test_steps_to_next_obs_raises_gamma():
    loss = make(alpha_init=0.2).make_value_estimator(gamma=0.9)
    data = batch(weights=None)
    data["steps_to_next_obs"] = torch.full((4, 1), 3)
    expected, _ = by_hand(loss, data, 0.9**3, 0.2, -5, 1)
    assert float(loss(data)["loss_qvalue"]) == pytest.approx(expected["loss_qvalue"], rel=1e-6)


def test_plain_sac_needs_no_expert_flag():
    loss = make(demonstration_weight=0.0)
    assert keys.IS_DEMONSTRATION not in loss.in_keys
    data = batch(experts=None)
    out = loss(data)
    expected, _ = by_hand(loss, data, 0.99, 0.01, -5, 0)
    assert float(out["loss_actor"]) == pytest.approx(expected["loss_actor"], rel=1e-6)
    assert out["demonstration_error"] == 0
    with pytest.raises(KeyError, match="demonstration_weight=0"):
        make()(data)


def gradients(loss, data, *names):
    loss.zero_grad()
    out = loss(data.clone())
    sum(out[name] for name in names).backward()
    return {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}


def test_each_term_reaches_its_own_parameters_only():
    loss, data = make(), batch()

    def owned(*prefixes):
        return {n for n, _ in loss.named_parameters() if n.startswith(prefixes)}

    assert gradients(loss, data, "loss_actor") == owned("actor_network_params")
    assert gradients(loss, data, "loss_qvalue") == owned("encoder_network", "qvalue_network")
    assert gradients(loss, data, "loss_alpha") == {"log_alpha"}
    everything = gradients(loss, data, "loss_actor", "loss_qvalue", "loss_alpha")
    assert everything == {name for name, _ in loss.named_parameters()}
    out = loss(data)
    for name in ("alpha", "entropy", "demonstration_error", "q_value"):
        assert not out[name].requires_grad


def test_soft_update_moves_the_targets():
    loss = make()
    updater = SoftUpdate(loss, tau=0.25)
    pairs = [("encoder_network_params", "net", "weight"), ("qvalue_network_params", "net", "bias")]
    with torch.no_grad():
        for name, *path in pairs:
            getattr(loss, name)["module", *path].add_(1.0)
    before = [getattr(loss, f"target_{name}")["module", *path].clone() for name, *path in pairs]
    updater.step()
    for (name, *path), old in zip(pairs, before, strict=True):
        source = getattr(loss, name)["module", *path]
        target = getattr(loss, f"target_{name}")["module", *path]
        torch.testing.assert_close(target, old + 0.25 * (source - old))
        assert not torch.equal(target, old)
    assert not any(n.startswith("target") for n, _ in loss.named_parameters())


def loss_names(out):
    return sorted(out.keys())


def test_renamed_keys():
    data = batch()
    plain, renamed = make(), make()
    expected = plain(data.clone())
    renames = {
        keys.ACTION: "act",
        keys.IS_DEMONSTRATION: ("meta", "demo"),
        (keys.NEXT, keys.REWARD): (keys.NEXT, "r"),
        (keys.NEXT, keys.TERMINATED): (keys.NEXT, "end"),
        (keys.NEXT, keys.DONE): (keys.NEXT, "stop"),
        "priority_weight": "w",
    }
    other = data.clone()
    for old, new in renames.items():
        other.rename_key_(old, new)
    renamed.qvalue_network.in_keys[1] = "act"
    renamed.set_keys(
        action="act",
        is_demonstration=("meta", "demo"),
        reward="r",
        terminated="end",
        done="stop",
        priority="prio",
        priority_weight="w",
    )
    assert {"act", ("meta", "demo"), ("next", "r")} <= set(renamed.in_keys)
    out = renamed(other)
    for name in loss_names(expected):
        torch.testing.assert_close(out[name], expected[name])
    assert other["prio"].shape == (4, 1)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        renamed.set_keys(colour="red")


def test_forward_accepts_keyword_tensors():
    loss, data = make(), batch(weights=None)
    expected = loss(data.clone())
    named = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    values = loss(**named)
    assert len(values) == len(loss.out_keys)
    for name, value in zip(loss.out_keys, values, strict=True):
        torch.testing.assert_close(value, expected[name])


def test_coefficients_can_be_scheduled_and_saved():
    loss, data = make(), batch()
    before = loss(data.clone())
    loss.demonstration_weight = 0.0
    loss.target_entropy = -3.0
    after = loss(data.clone())
    change = (before["loss_actor"] - after["loss_actor"]).detach()
    torch.testing.assert_close(change, before["demonstration_error"])
    assert after["loss_alpha"] != before["loss_alpha"]
    state = loss.state_dict()
    other = make(seed=5)
    other.load_state_dict(state)
    torch.testing.assert_close(other(data.clone())["loss_actor"], after["loss_actor"])


def test_invalid_arguments_are_refused():
    with pytest.raises(ValueError, match="alpha_init"):
        make(alpha_init=0.0)
    with pytest.raises(ValueError, match=r"demonstration_distance.*'mse', 'kl'.*'l1'"):
        make(demonstration_distance="l1")
    with pytest.raises(ValueError, match=r"weighted_terms .* 'actor'"):
        make(weighted_terms="actor")
    with pytest.raises(ValueError, match=r"weight_norm .* 'median'"):
        make(weight_norm="median")
    with pytest.raises(ValueError, match="reduction must be none, mean or sum, got 'max'"):
        make(reduction="max")
    with pytest.raises(NotImplementedError):
        make().make_value_estimator(ValueEstimators.TDLambda)


def test_reductions_are_the_losses_of_samples_their_mean_and_their_sum():
    data, found = batch(experts=(True,) * 4), {}
    for reduction in ("none", "mean", "sum"):
        found[reduction] = make(reduction=reduction)(data.clone())
    for name in ("loss_actor", "loss_qvalue", "loss_alpha"):
        losses = found["none"][name]
        assert losses.shape == (4,)
        torch.testing.assert_close(found["mean"][name], losses.mean())
        torch.testing.assert_close(found["sum"][name], losses.sum())
    assert found["none"]["demonstration_error"].shape == ()


def test_in_keys_can_be_set_and_follow_renamed_keys():
    loss, data = make(demonstration_weight=0.0), batch(weights=None)
    loss.in_keys = order = list(reversed(loss.in_keys))
    assert loss.in_keys == order
    by_position = loss(*(data[key] for key in loss.in_keys))
    by_name = loss(data)["loss_qvalue"]
    assert torch.equal(by_position[loss.out_keys.index("loss_qvalue")], by_name)
    loss.set_keys(action="chosen")
    assert "chosen" in loss.in_keys
    assert "action" not in loss.in_keys
