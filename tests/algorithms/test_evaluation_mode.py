"""Networks with dropout and batch norm act in evaluation mode, and are trained in training mode."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import EnsembleModule, TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.core import keys
from ba_torchrl.core.config import parse
from ba_torchrl.core.evaluation_mode import evaluation_copy
from ba_torchrl.modules.actor_critic.cnn import CNNConfig
from ba_torchrl.modules.base import ActorCritic
from ba_torchrl.modules.spatial.asr import ASRConfig
from tests.algorithms.tiny import FERM, SIZES, problem, transitions


class Noisy(nn.Module):
    """A module whose first output passes batch norm over the channels, and dropout."""

    def __init__(self, inner, channels, dim):
        super().__init__()
        self.inner, self.dim = inner, dim
        self.norm, self.dropout = nn.BatchNorm1d(channels), nn.Dropout(0.5)
        self.register_buffer("mask", torch.tensor([0.0, -torch.inf]))

    def forward(self, *inputs):
        out = self.inner(*inputs)
        first, *others = out if isinstance(out, tuple) else (out,)
        rows = first.movedim(self.dim, -1)
        rows = self.norm(rows.reshape(-1, rows.shape[-1])).reshape(rows.shape)
        first = self.dropout(rows.movedim(-1, self.dim))
        return (first, *others) if others else first


class NoisyCNN(CNNConfig):
    def build(self, spec):
        actor, encoder, critic = super().build(spec)
        features = encoder(torch.zeros(1, 1, 64, 64), torch.zeros(1, 1)).shape[1]
        if spec.critics is None:
            critic = Noisy(critic, 2, -1)
        else:  # an ensemble
            critic.first = Noisy(critic.first, critic.first.out_features, -1)
        return ActorCritic(Noisy(actor, spec.action_size, -1), Noisy(encoder, features, -1), critic)


class NoisyASR(ASRConfig):
    def build(self, spec):
        network = super().build(spec)
        network.positions = Noisy(network.positions, 1, 1)
        return network


def build(algorithm, network="cnn", **settings):
    torch.manual_seed(0)
    config = parse(ALGORITHMS[algorithm], {"batch_size": 8, **settings}, algorithm)
    kind = NoisyASR if network == "asr" else NoisyCNN
    learner = config.build(parse(kind, SIZES[network], network), problem(network))
    learner.extend(transitions(learner))
    return learner


def buffers(module):
    return [each.clone() for each in module.buffers()]


def are_equal(first, second):
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


CASES = [
    ("bc", "cnn", {}, {"actor_network": 1}),
    ("bc", "asr", {}, {"value_network": 1}),
    ("dagger", "cnn", {"optimizer": {"policy_average": 0.5}}, {"actor_network": 1}),
    ("flow", "cnn", {"optimizer": {"policy_average": 0.5}}, {"actor_network": 1}),
    ("iql", "cnn", {}, {"actor_network": 1, "qvalue_network": 1, "value_network": 1}),
    # the critics' features are also those of the policy's term; its values are of other actions
    ("sac", "cnn", {}, {"actor_network": 1, "encoder_network": 1, "qvalue_network": 2}),
    ("sac", "cnn", FERM, {"actor_network": 1, "encoder_network": 2, "qvalue_network": 2}),
    ("rlpd", "cnn", {"critic_updates": 2}, {"encoder_network": 2, "qvalue_network": 3}),
    ("spatial_q", "asr", {"target_interval": 2}, {"value_network": 1}),
]


@pytest.mark.parametrize(("algorithm", "network", "settings", "counts"), CASES)
def test_only_updates_are_in_training_mode(algorithm, network, settings, counts):
    learner = build(algorithm, network, **settings)
    initial = learner.loss.state_dict()
    assert not any(torch.count_nonzero(n) for key, n in initial.items() if "num_batches" in key)
    learner.update()
    for name, value in learner.loss.state_dict().items():
        if name.endswith("num_batches_tracked"):
            part = name.split("_params")[0]
            assert (value == counts.get(part, int(not part.startswith("target")))).all(), name
    seen = transitions(learner).select(*learner.policy.in_keys)
    before = buffers(learner.loss), buffers(learner.policy)
    learner.policy.train()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = (learner.policy(seen.clone())[keys.ACTION] for _ in range(2))
        assert torch.equal(first, second)
        other = build(algorithm, network, **settings)
        other.load_state_dict(learner.state_dict())
        assert torch.equal(other.policy(seen.clone())[keys.ACTION], first)
    with torch.no_grad():
        learner.loss(learner.sample())
    assert are_equal(before[0], buffers(learner.loss))
    assert are_equal(before[1], buffers(learner.policy))
    assert learner.trained_policy.training


@pytest.mark.parametrize(
    ("algorithm", "network", "settings", "steps"),
    [
        ("sac", "cnn", {"tau": 0.25}, {"qvalue": [0.25], "encoder": [0.25]}),
        ("sac", "cnn", {"encoder_tau": 0.25}, {"qvalue": [0.01], "encoder": [0.25]}),
        ("iql", "cnn", {"tau": 0.25}, {"qvalue": [0.25]}),
        ("spatial_q", "asr", {"target_interval": 2}, {"value": [0.0, 1.0]}),
    ],
)
def test_the_statistics_of_targets_move_as_their_parameters(algorithm, network, settings, steps):
    learner = build(algorithm, network, **settings)
    for weights in zip(*steps.values(), strict=True):
        before = learner.loss.state_dict()
        before = {name: value.clone() for name, value in before.items()}
        learner.update()
        after = learner.loss.state_dict()
        for part, weight in zip(steps, weights, strict=True):
            for name in [name for name in after if name.startswith(f"target_{part}_network")]:
                value, online = after[name], after[name.removeprefix("target_")]
                if "mask" in name:
                    assert torch.equal(value, online)
                elif value.is_floating_point():
                    expected = torch.lerp(before[name], online, weight)
                    torch.testing.assert_close(value, expected, msg=name)


def test_the_average_of_a_policy_has_statistics_of_its_own():
    learner = build("bc", optimizer={"policy_average": 0.5})
    history = []
    for _ in range(2):
        learner.update()
        history.append(TensorDict.from_module(learner.trained_policy).data.clone())
    for key, value in TensorDict.from_module(learner.averaged_policy.module).items(True, True):
        first, second = history[0][key], history[1][key]
        if value.is_floating_point() and "mask" not in key:
            second = (first + second) / 2
        torch.testing.assert_close(value.detach(), second)


def test_a_copy_shares_the_parameters_that_a_tensordict_holds():
    network = EnsembleModule(TensorDictModule(nn.Linear(2, 3), ["seen"], ["action"]), 2)
    acting = evaluation_copy(network)
    assert [*map(id, acting.parameters())] == [*map(id, network.parameters())]
    assert network.training
    assert not acting.training


def test_a_copy_of_escnn_layers_has_the_latest_filters():
    planar_escnn = pytest.importorskip("profiling.planar_escnn")
    escnn, rotations = planar_escnn.nn, planar_escnn.gspaces.rot2dOnR2(4)
    one, two = (
        escnn.FieldType(rotations, [each])
        for each in (rotations.trivial_repr, rotations.regular_repr)
    )
    network = escnn.R2Conv(one, two, 3)
    acting = ActingPolicy(TensorDictModule(network, ["seen"], ["action"]), []).policy.module
    image = escnn.GeometricTensor(torch.rand(1, 1, 5, 5), one)
    torch.nn.init.normal_(network.weights)
    torch.testing.assert_close(acting(image).tensor, network(image).tensor)
