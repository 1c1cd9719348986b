"""Implicit Q-learning: TorchRL's loss is given the right networks and values."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.record.logging import read_scalars
from tests.algorithms.tiny import build, run, transitions

UNUSUAL = {
    "expectile": 0.8,
    "temperature": 2.5,
    "std_min": 0.2,
    "gamma": 0.7,
    "tau": 0.3,
    "batch_size": 6,
    "optimizer": {"learning_rate": 0.003, "weight_decay": 0.02},
}


def values_of(params, index=None):
    """Return one network's parameters, detached."""
    params = params.data if index is None else params.data[index]
    return params.clone()


@pytest.mark.parametrize("network", ["cnn", "equi"])
def test_the_terms_are_those_of_the_paper(network):
    learner = build("iql", network, **UNUSUAL)
    loss, batch = learner.loss, transitions(learner)
    batch[keys.NEXT, keys.TERMINATED][::3] = True
    with torch.no_grad():
        for value in loss.target_qvalue_network_params.values(True, True):
            value.mul_(0.7)
    found = loss(batch.clone())

    def call(module, params, data):
        with torch.no_grad(), params.to_module(module, preserve_module_state=False):
            return module(data.select(*module.in_keys)).clone()

    def state_value(data):
        params = values_of(loss.value_network_params)
        return call(loss.value_network, params, data)["state_value"][:, 0]

    def q(params):
        networks = (values_of(params, k) for k in range(2))
        found = [call(loss.qvalue_network, each, batch) for each in networks]
        return torch.stack([each["state_action_value"][:, 0] for each in found], dim=1)

    goes_on = (~batch[keys.NEXT, keys.TERMINATED][:, 0]).float()
    y = batch[keys.NEXT, keys.REWARD][:, 0] + 0.7 * goes_on * state_value(batch[keys.NEXT])
    error = q(loss.qvalue_network_params) - y[:, None]
    torch.testing.assert_close(found["loss_qvalue"].detach(), error.square().sum(1).mean())

    advantage = q(loss.target_qvalue_network_params).amin(dim=1) - state_value(batch)
    weight = torch.where(advantage > 0, 0.8, 0.2)
    torch.testing.assert_close(found["loss_value"].detach(), (weight * advantage**2).mean())

    params = call(loss.actor_network[0], values_of(loss.actor_network_params)["module", "0"], batch)
    mean, std = params["loc"].tanh(), params["scale"]
    assert (std >= 0.3).all()
    assert (std <= 1).all()
    normal = torch.distributions.Normal(mean, std)
    inside = normal.cdf(torch.ones(())) - normal.cdf(-torch.ones(()))
    log_prob = (normal.log_prob(batch[keys.ACTION]) - inside.log()).sum(dim=1)
    expected = -((2.5 * advantage).exp().clamp_max(100) * log_prob).mean()
    torch.testing.assert_close(found["loss_actor"].detach(), expected, rtol=1e-4, atol=1e-4)


def test_every_term_trains_its_own_network():
    learner = build("iql", **UNUSUAL)
    found = learner.loss(transitions(learner))
    names = ("actor", "qvalue", "value")
    for name in names:
        learner.loss.zero_grad()
        found[f"loss_{name}"].backward(retain_graph=True)
        for other in names:
            parameters = list(getattr(learner.loss, f"{other}_network_params").values(True, True))
            trained = [p.grad is not None and bool((p.grad != 0).any()) for p in parameters]
            assert any(trained) == (name == other)


def test_the_two_critics_start_different_and_their_targets_follow():
    learner = build("iql", **UNUSUAL)
    learner.extend(transitions(learner))
    online = learner.loss.qvalue_network_params
    target = learner.loss.target_qvalue_network_params
    name = ("module", "critic", "first", "weight")
    before = target[name].clone()
    assert not torch.equal(before[0], before[1])
    learner.update()
    torch.testing.assert_close(target[name], 0.7 * before + 0.3 * online[name])


def test_actions_at_the_ends_of_the_range_have_bounded_likelihood():
    learner = build("iql", std_min=0.3)
    batch = transitions(learner)
    batch[keys.ACTION] = batch[keys.ACTION].sign()
    distribution = learner.policy.policy.get_dist(batch.select(*learner.observation_keys))
    assert (distribution.log_prob(batch[keys.ACTION]) > -200).all()


def test_the_policy_acts_within_the_range_and_greedily_at_its_mode():
    learner = build("iql", std_min=1.0)
    state = transitions(learner).select(*learner.observation_keys)
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = (learner.policy(state.clone())[keys.ACTION] for _ in range(2))
    assert not torch.equal(first, second)
    assert (first.abs() <= 1).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(state.clone())[keys.ACTION]
    depth = make_codecs(learner.images)["depth"](state[keys.DEPTH])  # as the policy sees them
    loc = learner.policy.policy[0](state.clone().set(keys.DEPTH, depth))["loc"]
    torch.testing.assert_close(greedy, loc.tanh())


@pytest.mark.parametrize(
    ("pretrain_updates", "init"),
    [(2, {"name": "random"}), (1, {"name": "random"}), (2, {"name": "bc", "updates": 1})],
)
def test_two_updates_offline_or_online(tmp_path, pretrain_updates, init):
    algorithm = {"name": "iql", "init": init}
    learner = run(tmp_path, "cnn", algorithm, pretrain_updates=pretrain_updates)
    is_demonstration = learner.replay.storage.column(keys.IS_DEMONSTRATION)
    assert (~is_demonstration).sum() == (0 if pretrain_updates == 2 else 2)
    assert read_scalars(tmp_path / "run")["train/env_steps"].values[-1] == (~is_demonstration).sum()
