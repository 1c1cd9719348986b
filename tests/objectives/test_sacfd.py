"""The losses of SACfD and RLPD against plain arithmetic, and against TorchRL's contract."""

import copy
import itertools
import math
import statistics

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Bernoulli, kl_divergence
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from ba_torchrl.core import keys
from ba_torchrl.objectives.rlpd import RLPDLoss
from ba_torchrl.objectives.sacfd import BilinearInfoNCE, SACfDLoss, SoftUpdateByNetwork
from tests.linear_sac import batch, make


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
    norm="mean",
    entropy_backup=True,
    of_policy=min,
):
    """The terms of the loss, computed with Python floats and loops.

    ``of_policy`` is the value of the critics' values that the policy maximises.
    """

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
        return [*tree[keys.DEPTH][i].tolist(), float(tree[keys.HOLDING][i])]

    n = len(data)
    critic, policy_weights, others = importance(data, terms, norm)
    qvalue = actor_term = alpha_term = entropy = value = spread = 0.0
    behaviour = weighted_behaviour = 0.0
    experts = 0
    share, priorities = 0.0, []  # of the demonstrations in the mean of their term
    for i in range(n):
        x, following = observation(data, i), observation(data[keys.NEXT], i)
        stored = data[keys.ACTION][i].tolist()
        next_action, next_log_prob = policy(following)
        bootstrap = min(q(following, next_action, "target_"))
        bootstrap -= alpha * next_log_prob * entropy_backup
        y = float(data[keys.NEXT, keys.REWARD][i])
        if not data[keys.NEXT, keys.TERMINATED][i]:
            y += gamma * bootstrap
        values = q(x, stored, "")
        errors = [v - y for v in values]
        qvalue += critic[i] * sum(e * e for e in errors) / n
        value += statistics.mean(values) / n
        spread += statistics.stdev(values) / n
        priorities.append([statistics.mean(map(abs, errors))])
        action, log_prob = policy(x)
        actor_term += policy_weights[i] * (alpha * log_prob - of_policy(q(x, action, ""))) / n
        alpha_term -= others[i] * math.log(alpha) * (log_prob + target_entropy) / n
        entropy -= log_prob / n
        if keys.IS_DEMONSTRATION in data and data[keys.IS_DEMONSTRATION][i]:
            share += others[i] if norm == "mean" else 1
            experts += 1
            error = sum((a - e) ** 2 for a, e in zip(action, stored, strict=True)) / 2
            behaviour += error
            weighted_behaviour += others[i] * error
    behaviour /= max(experts, 1)
    weighted_behaviour /= share or 1
    return {
        "loss_qvalue": qvalue,
        "loss_actor": actor_term + demonstration_weight * weighted_behaviour,
        "loss_alpha": alpha_term,
        "alpha": alpha,
        "entropy": entropy,
        "demonstration_error": behaviour,
        "q_value": value,
        "q_std": spread,
    }, priorities


def assert_terms(out, expected):
    for name, value in out.items():
        assert value.item() == pytest.approx(expected[name], rel=1e-6), name


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
    assert set(out.keys()) == set(loss.out_keys)
    assert_terms(out, expected)
    assert data[keys.TD_ERROR].shape == (4, 1)
    expected_priorities = torch.tensor(priorities, dtype=torch.float64)
    torch.testing.assert_close(data[keys.TD_ERROR], expected_priorities, rtol=1e-6, atol=0)


@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("terms", ["none", "critic", "critic_and_policy", "all"])
def test_importance_weights_multiply_the_chosen_terms(terms, norm):
    loss = make(alpha_init=0.2, target_entropy=-1.5, weighted_terms=terms, weight_norm=norm)
    data = batch()
    expected, _ = by_hand(loss, data, 0.99, 0.2, -1.5, 1.0, terms, norm)
    assert_terms(loss(data), expected)


def test_defaults_are_those_of_the_appendix_and_the_entropy_can_be_left_out_of_the_target():
    data, losses = batch(), []
    for backup in (True, False):
        loss = make(entropy_backup=backup)
        expected, _ = by_hand(loss, data, 0.99, 0.01, -2, 1, entropy_backup=backup)
        out = loss(data)
        assert_terms(out, expected)
        losses.append(out["loss_qvalue"].item())
    assert losses[0] != pytest.approx(losses[1], rel=1e-4)


def test_the_automatic_target_entropy_is_minus_the_size_of_an_action():
    loss, data = make(), batch()
    assert loss.target_entropy.isnan()
    undecided, chosen = copy.deepcopy(loss.state_dict()), make(target_entropy=-1.5)
    for state, expected in ((undecided, -2.0), (chosen.state_dict(), -1.5)):
        loss.load_state_dict(state)
        loss(data)
        assert loss.target_entropy == expected
    chosen.load_state_dict(undecided)
    chosen(data)
    assert chosen.target_entropy == -2.0
    spec = Bounded(-1.0, 1.0, (4,))
    actor = ProbabilisticActor(
        TensorDictModule(nn.Identity(), ["observation"], ["loc", "scale"]),
        ["loc", "scale"],
        spec=spec,
    )
    networks = chosen.encoder_network, chosen.qvalue_network
    assert SACfDLoss(actor, *networks).target_entropy == -4.0


def test_steps_to_next_obs_raises_gamma():
    loss = make(alpha_init=0.2).make_value_estimator(gamma=0.9)
    data = batch(weights=None)
    data["steps_to_next_obs"] = torch.full((4, 1), 3)
    expected, _ = by_hand(loss, data, 0.9**3, 0.2, -5, 1)
    assert loss(data)["loss_qvalue"].item() == pytest.approx(expected["loss_qvalue"], rel=1e-6)


def test_plain_sac_needs_no_expert_flag():
    loss = make(demonstration_weight=0.0)
    assert keys.IS_DEMONSTRATION not in loss.in_keys
    data = batch(experts=None)
    out = loss(data)
    expected, _ = by_hand(loss, data, 0.99, 0.01, -5, 0)
    assert out["loss_actor"].item() == pytest.approx(expected["loss_actor"], rel=1e-6)
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
    for critic in (renamed.qvalue_network, renamed.qvalue_network_in_evaluation_mode):
        critic.in_keys[1] = "act"
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
    for name in plain.out_keys:
        torch.testing.assert_close(out[name], expected[name])
    assert other["prio"].shape == (4, 1)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        renamed.set_keys(colour="red")


def test_coefficients_can_be_scheduled_and_saved():
    loss, data = make(), batch()
    before = loss(data.clone())
    loss.demonstration_weight = 0.0
    assert keys.IS_DEMONSTRATION not in loss.in_keys
    loss.target_entropy = -3.0
    after = loss(data.clone())
    change = (before["loss_actor"] - after["loss_actor"]).detach()
    torch.testing.assert_close(change, before["demonstration_error"])
    assert after["loss_alpha"] != before["loss_alpha"]
    state = loss.state_dict()
    other = make(seed=5)
    other.load_state_dict(state)
    torch.testing.assert_close(other(data.clone())["loss_actor"], after["loss_actor"])


@pytest.mark.parametrize("is_loaded", [False, True])
def test_a_behaviour_weight_that_rises_from_zero_counts(is_loaded):
    loss, data = make(demonstration_weight=0.0), batch()
    expected = make(demonstration_weight=0.3)(data.clone())
    if is_loaded:
        loss.load_state_dict(make(demonstration_weight=0.3).state_dict())
    else:
        loss.demonstration_weight = 0.3
    assert keys.IS_DEMONSTRATION in loss.in_keys
    torch.testing.assert_close(dict(loss(data.clone())), dict(expected))
    with pytest.raises(KeyError, match="the batch lacks 'is_demonstration'"):
        loss(data.exclude(keys.IS_DEMONSTRATION))


class OneValue(nn.Module):
    """A single one of the critics' values, from the observation."""

    def __init__(self, loss, number):
        super().__init__()
        self.encoder, self.critics = loss.encoder_network.module, loss.qvalue_network.module
        self.register_buffer("share", torch.eye(2, dtype=torch.float64)[number])

    def forward(self, depth, holding, action):
        values = self.critics(self.encoder(depth, holding), action)
        return (self.share * values).sum(dim=-1, keepdim=True)


@pytest.mark.parametrize("uses_weights", ["auto", False])
@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_without_demonstrations_the_loss_is_torchrls(reduction, is_masked, uses_weights):
    data, options = batch(), {"reduction": reduction, "use_prioritized_weights": uses_weights}
    if is_masked:
        data["collector", "mask"] = torch.tensor([[True], [False], [True], [True]])
    settings = {"alpha_init": 0.2, "target_entropy": -1.5}
    ours = make(demonstration_weight=0.0, weighted_terms="all", **settings, **options)
    inputs = [keys.DEPTH, keys.HOLDING, keys.ACTION]
    critics = [TensorDictModule(OneValue(ours, k), inputs, ["state_action_value"]) for k in (0, 1)]
    theirs = SACLoss(ours.actor_network, critics, loss_function="l2", **settings, **options)
    SoftUpdate(theirs, tau=0.01)
    for name in ("encoder", "critics"):
        theirs.target_qvalue_network_params["module", name].data.mul_(0.7)
    expected, found = theirs(data.clone()), ours(data)
    for name in ("loss_actor", "loss_qvalue", "loss_alpha"):
        torch.testing.assert_close(found[name], expected[name])


@pytest.mark.parametrize("norm", ["max", "mean"])
@pytest.mark.parametrize("experts", [(True, False, True, False), (False, True, False, False)])
def test_masked_samples_do_not_count(experts, norm):
    data, mask = batch(experts), torch.tensor([True, False, True, True])
    loss = make(weighted_terms="all", weight_norm=norm)
    expected = loss(data[mask])
    data["collector", "mask"] = mask[:, None]
    data[keys.NEXT, keys.REWARD][~mask] = torch.nan
    torch.testing.assert_close(dict(loss(data)), dict(expected))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpha_init": 0.0}, "alpha_init"),
        ({"demonstration_distance": "l1"}, r"demonstration_distance.*'mse', 'kl'.*'l1'"),
        ({"weighted_terms": "actor"}, r"weighted_terms .* 'actor'"),
        ({"weight_norm": "median"}, r"weight_norm .* 'median'"),
        ({"reduction": "max"}, "reduction is one of 'none', 'mean', 'sum', not 'max'"),
    ],
)
def test_invalid_arguments_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        make(**settings)
    with pytest.raises(NotImplementedError):
        make().make_value_estimator(ValueEstimators.TDLambda)


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


# -- the behaviour term --------------------------------------------------------------------------


EXPERTS = (True, True, False, True)
WEIGHTS = (0.2, 0.8, 0.4, 0.1)


def test_the_term_with_the_divergence_of_actions():
    data = batch(EXPERTS, WEIGHTS)
    data[keys.ACTION][0, 0] = 1.0  # at the end of the range, as the gripper's commands are
    options = {"demonstration_distance": "kl", "weighted_terms": "all"}
    loss = make(demonstration_weight=0.3, **options)
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network.get_dist(data).rsample()
    expert, policy = (Bernoulli((1 + value) / 2) for value in (data[keys.ACTION], action))
    distances = 2 * kl_divergence(expert, policy).mean(dim=-1)
    found = loss(data.clone())
    flags = torch.tensor(EXPERTS)
    torch.testing.assert_close(found["demonstration_error"], distances[flags].mean())
    weights = torch.tensor(WEIGHTS, dtype=distances.dtype)[flags]
    without = make(demonstration_weight=0.0, **options)(data.clone())  # with the same parameters
    difference = found["loss_actor"] - without["loss_actor"]
    expected = 0.3 * (weights * distances[flags]).sum() / weights.sum()
    torch.testing.assert_close(difference, expected, rtol=1e-5, atol=0)


def test_the_term_is_against_the_entry_of_the_expert():
    data, executed = batch(EXPERTS), batch(EXPERTS)
    data["label"] = data[keys.ACTION].clone()
    data[keys.ACTION] = -data[keys.ACTION] / 3  # what was executed in place of the expert's action
    loss = make(demonstration_weight=0.3)
    loss.set_keys(target_action="label")
    assert {"label", keys.ACTION} <= set(loss.in_keys)
    found, expected = loss(data), make(demonstration_weight=0.3)(executed)
    for name in ("loss_actor", "demonstration_error", "entropy"):
        torch.testing.assert_close(found[name], expected[name])
    assert not torch.allclose(found["loss_qvalue"], expected["loss_qvalue"])
    with pytest.raises(KeyError, match="label"):
        loss(data.exclude("label"))


# -- several views of each observation (DrQ) -----------------------------------------------------

VIEWS, TARGET_VIEWS = 3, 2


def views_of(data, count, path=()):
    """Return views [count] of an observation: batches with different pixels."""
    generator = torch.Generator().manual_seed(count)
    views = []
    for _ in range(count):
        view = data.clone()
        noise = torch.rand(data[(*path, keys.DEPTH)].shape, generator=generator)
        view[(*path, keys.DEPTH)] += noise.double()
        views.append(view)
    return views


def with_views(data):
    """Return a batch with views, and its parts as batches with a single one."""
    states, followings = views_of(data, VIEWS), views_of(data, TARGET_VIEWS, (keys.NEXT,))
    out = data.clone()
    for key in (keys.DEPTH, keys.HOLDING):
        out[key] = torch.stack([view[key] for view in states], dim=1)
        nested = (keys.NEXT, key)
        out[nested] = torch.stack([view[nested] for view in followings], dim=1)
    return out, states, followings


def test_the_target_is_the_mean_over_the_views_of_the_next_observation():
    data, _, followings = with_views(batch())
    loss = make(views=VIEWS, target_views=TARGET_VIEWS, alpha_init=0.2)
    single = make(alpha_init=0.2)
    targets = torch.stack([single._target(view) for view in followings])
    assert not torch.allclose(targets[0], targets[1])
    torch.testing.assert_close(loss._target(data), targets.mean(dim=0))


@pytest.mark.parametrize("terms", ["none", "all"])
def test_losses_and_priorities_are_means_over_the_views_of_the_observation(terms):
    data, states, _ = with_views(batch())
    settings = {"alpha_init": 0.2, "weighted_terms": terms}
    loss = make(views=VIEWS, target_views=TARGET_VIEWS, **settings)
    out, target = loss(data), loss._target(data)
    single, found = make(**settings), []
    for state in states:
        # a terminated transition, whose target is its reward
        state[keys.NEXT, keys.REWARD] = target
        state[keys.NEXT, keys.TERMINATED] |= True
        found.append(single(state))
    for name in single.out_keys:
        expected = torch.stack([values[name] for values in found]).mean()
        torch.testing.assert_close(out[name], expected)
    priorities = torch.stack([state[keys.TD_ERROR] for state in states]).mean(dim=0)
    torch.testing.assert_close(data[keys.TD_ERROR], priorities)


def test_one_view_of_either_kind():
    data, states, followings = with_views(batch())
    one_state, one_target = data.clone(), data.clone()
    for key in (keys.DEPTH, keys.HOLDING):
        one_state[key] = states[0][key]
        one_target[keys.NEXT, key] = followings[0][keys.NEXT, key]
    assert torch.isfinite(make(target_views=TARGET_VIEWS)(one_state)["loss_qvalue"])
    assert torch.isfinite(make(views=VIEWS)(one_target)["loss_qvalue"])


# -- the contrastive term ------------------------------------------------------------------------


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
    assert 0 <= head.weight.min().item() <= head.weight.max().item() < 1
    anchors, positives = torch.randn(5, 3).double(), torch.randn(5, 3).double()
    expected = loop(anchors.tolist(), head.weight.tolist(), positives.tolist())
    assert head(anchors, positives).tolist() == pytest.approx(expected, rel=1e-9)


def with_positives(data):
    data = data.clone()
    generator = torch.Generator().manual_seed(5)
    shape = data[keys.DEPTH].shape
    data[keys.POSITIVE, keys.DEPTH] = torch.rand(shape, generator=generator, dtype=torch.float64)
    data[keys.POSITIVE, keys.HOLDING] = data[keys.HOLDING]
    return data


def features(loss, params, tree):
    weight = getattr(loss, params)["module", "net", "weight"].tolist()
    bias = getattr(loss, params)["module", "net", "bias"].tolist()
    inputs = torch.cat([tree[keys.DEPTH], tree[keys.HOLDING].double()], dim=1).tolist()
    return [[math.tanh(v) for v in affine(weight, bias, x)] for x in inputs]


def contrastive(**settings):
    torch.manual_seed(1)
    return make(contrastive=BilinearInfoNCE(4), **settings)


def test_anchors_are_features_and_positives_those_of_the_target_encoder():
    loss, data = contrastive(), with_positives(batch())
    anchors = features(loss, "encoder_network_params", data)
    positives = features(loss, "target_encoder_network_params", data[keys.POSITIVE])
    expected = loop(anchors, loss.contrastive.weight.tolist(), positives)
    out = loss.contrastive_loss(data)
    assert list(out.keys()) == ["loss_contrastive"]
    assert out["loss_contrastive"].item() == pytest.approx(sum(expected) / 4, rel=1e-9)
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


@pytest.mark.parametrize("encoder_tau", [0.25, 0.5])
def test_targets_follow_and_the_encoders_can_have_a_rate_of_its_own(encoder_tau):
    loss = make()
    updater = SoftUpdate(loss, tau=0.25)
    if encoder_tau != 0.25:
        updater = SoftUpdateByNetwork(loss, tau=0.25, taus={"encoder_network": encoder_tau})
    before = {}
    rates = {"encoder_network": encoder_tau, "qvalue_network": 0.25}
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
    assert not any(n.startswith("target") for n, _ in loss.named_parameters())


# -- an ensemble of critics (RLPD) ---------------------------------------------------------------

CRITICS = 4


def rlpd(draws=0, **settings):
    options = {"kind": RLPDLoss, "critics": CRITICS, "alpha_init": 0.2, "target_entropy": -1.5}
    loss = make(**options, **settings)
    loss.generator.manual_seed(draws)
    return loss.make_value_estimator(gamma=0.9).double()


@pytest.mark.parametrize("entropy_backup", [False, True])
def test_the_policy_maximises_the_mean_of_the_ensemble(entropy_backup):
    loss, data = rlpd(subset=CRITICS, entropy_backup=entropy_backup), batch(weights=None)
    options = {"entropy_backup": entropy_backup, "of_policy": statistics.mean}
    expected, _ = by_hand(loss, data, 0.9, 0.2, -1.5, 0, **options)
    out = loss(data)
    assert set(out.keys()) == set(loss.out_keys)
    assert_terms(out, expected)


def test_targets_are_from_random_subsets_of_the_given_size(monkeypatch):
    loss, data = rlpd(subset=2, draws=3), batch(weights=None)

    def target():
        return tuple(loss._target(data)[:, 0].numpy().round(6).tolist())

    drawn, expected = {target() for _ in range(60)}, set()
    for pair in itertools.combinations(range(CRITICS), 2):
        # pairs with the same lowest critic have the same target
        lowest = lambda q, pair=pair: q[..., list(pair)].amin(dim=-1)  # noqa: E731
        monkeypatch.setattr(loss, "_target_value", lowest)
        expected.add(target())
    assert drawn == expected
    assert len(expected) >= 3


def test_the_critics_alone_have_the_same_loss():
    first, second, data = rlpd(draws=1), rlpd(draws=1), batch(weights=None)
    critic = first.critic_loss(data)
    assert "loss_actor" not in critic
    torch.testing.assert_close(critic["loss_qvalue"], second(data)["loss_qvalue"])
