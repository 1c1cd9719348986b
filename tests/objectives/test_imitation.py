import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.distributions import Bernoulli, kl_divergence
from torchrl.modules import QValueActor, TanhNormal

from ba_torchrl.core import keys
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.spatial.policy import SpatialValues
from ba_torchrl.objectives.distance import action_distance
from ba_torchrl.objectives.imitation import BehaviourCloningLoss, LevelCrossEntropyLoss
from tests.level_tables import ACTIONS, Tables, batch as level_batch
from tests.linear_sac import batch


class Constant(nn.Module):
    """A Gaussian that does not depend on the observation."""

    def __init__(self, loc, scale):
        super().__init__()
        self.loc = nn.Parameter(torch.tensor(loc, dtype=torch.float64))
        self.log_scale = nn.Parameter(torch.tensor(scale, dtype=torch.float64).log())

    def forward(self, depth, holding):
        return tuple(p.expand(len(depth), -1) for p in (self.loc, self.log_scale.exp()))


OBSERVATION = [keys.DEPTH, keys.HOLDING]


@pytest.mark.parametrize("distance", ["mse", "kl"])
def test_the_error_is_that_of_the_drawn_action(distance):
    actor = Constant([0.3, -0.4], [0.5, 0.2])
    loss = BehaviourCloningLoss(squashed_gaussian_policy(actor, OBSERVATION), distance)
    data = batch()
    torch.manual_seed(5)
    found = loss(data)["loss_bc"]
    torch.manual_seed(5)
    noise = torch.randn(4, 2, dtype=torch.float64)
    drawn = torch.tanh(actor.loc + actor.log_scale.exp() * noise)
    expert = data[keys.ACTION]
    if distance == "mse":
        expected = (drawn - expert).square().mean()
    else:
        expert, policy = (Bernoulli((1 + action) / 2) for action in (expert, drawn))
        expected = 2 * kl_divergence(expert, policy).mean()
    torch.testing.assert_close(found, expected)
    found.backward()
    assert (actor.loc.grad != 0).all()
    assert (actor.log_scale.grad != 0).all()


@pytest.mark.parametrize("loc", [[0.3, -0.4], [7.0, -8.0]], ids=["centre", "ends of the range"])
def test_the_entropy_term_is_that_of_the_drawn_action(loc):
    actor = Constant(loc, [0.5, 0.2])
    policy = squashed_gaussian_policy(actor, OBSERVATION)
    plain, loss = BehaviourCloningLoss(policy), BehaviourCloningLoss(policy, entropy_weight=0.3)
    assert list(plain.out_keys) == ["loss_bc"]
    assert list(loss.out_keys) == ["loss_bc", "entropy"]
    data = batch()
    torch.manual_seed(5)
    error = plain(data)["loss_bc"]
    torch.manual_seed(5)
    found = loss(data)
    torch.manual_seed(5)
    noise, scale = torch.randn(4, 2, dtype=torch.float64), actor.log_scale.exp()
    u = actor.loc + scale * noise
    gaussian = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
    log_prob = (gaussian - (1 - torch.tanh(u).square()).log()).sum(dim=-1).mean()
    torch.testing.assert_close(found["loss_bc"], error + 0.3 * log_prob)
    torch.testing.assert_close(found["entropy"], -log_prob)
    assert not found["entropy"].requires_grad


class Shifted(nn.Module):
    """An almost deterministic policy: the first two components of the image."""

    def forward(self, depth, holding):
        return depth[..., :2].atanh(), torch.full_like(depth[..., :2], 1e-9)


def test_every_view_of_an_observation_is_compared_with_the_action():
    loss = BehaviourCloningLoss(squashed_gaussian_policy(Shifted(), OBSERVATION))
    action = torch.tensor([[0.1, 0.2], [-0.3, 0.4]])
    views = action[:, None] + torch.tensor([0.0, 0.1, -0.2])[:, None]
    data = {keys.DEPTH: views, keys.HOLDING: torch.zeros(2, 3, 1).bool(), keys.ACTION: action}
    found = loss(TensorDict(data, [2]))["loss_bc"]
    assert found.item() == pytest.approx((0.1**2 + 0.2**2) / 3, rel=1e-4)


class TwoLevels(nn.Module):
    """Values [B, 3] and [B, 2]; the action holds the choices."""

    in_keys = ("depth",)
    action_dims = 1

    def __init__(self):
        super().__init__()
        self.first = nn.Parameter(torch.tensor([0.0, math.log(2), math.log(5)]))
        self.second = nn.Parameter(torch.tensor([0.0, math.log(3)]))

    def forward(self, depth, action):
        chosen = action.long()
        count = len(depth)
        return [
            (self.first.expand(count, 3), chosen[:, 0]),
            (self.second.expand(count, 2), chosen[:, 1]),
        ]


def test_cross_entropies_are_averaged_over_the_batch_and_summed_over_levels():
    loss = LevelCrossEntropyLoss(TwoLevels())
    data = TensorDict(
        {"depth": torch.zeros(2, 1), keys.ACTION: torch.tensor([[2.0, 0.0], [1.0, 1.0]])}, [2]
    )
    found = loss(data)
    # softmax: (1, 2, 5) / 8 and (1, 3) / 4
    first = -(math.log(5 / 8) + math.log(2 / 8)) / 2
    second = -(math.log(1 / 4) + math.log(3 / 4)) / 2
    assert found["loss_bc"].item() == pytest.approx(first + second, rel=1e-6)
    assert float(found["accuracy"]) == 0.5  # right at one level of two in either sample
    assert not found["accuracy"].requires_grad


def moves_batch(samples=6, moves=4):
    """A batch of `Tables`, with sets of actions [B, K, A] in which one action is repeated."""
    data = level_batch(samples)
    chosen = data["chosen"][:, None].repeat(1, moves, 1)
    chosen[:, 1, 2:] = 0  # the same pixel and other angles
    chosen[:, 2, 0] = (chosen[:, 2, 0] + 1) % 3  # another pixel
    indices = chosen[:, [0, 1, 2, 0]]
    data["action"] = ACTIONS.to_action(indices, data["holding"][:, None].expand(-1, moves, 1))
    return data, indices


def test_the_loss_of_a_set_is_that_of_its_summed_probability():
    network, (data, indices) = Tables(), moves_batch()
    loss = LevelCrossEntropyLoss(SpatialValues(network, ACTIONS), "none", of_sets=True)
    found, expected, hits = loss(data), [], []
    for row, sample in zip(data, indices.tolist(), strict=True):
        primitive, scale = int(row["holding"]), float(row["heightmap"].mean())
        left, before, total = {tuple(move) for move in sample}, (), 0.0
        for table, size in zip(network.tables, (2, 1, 1, 1, 1), strict=True):
            q = table[(primitive, *before)].detach().double() * scale
            p = q.exp() / q.exp().sum()
            ends = {move[len(before) : len(before) + size] for move in left}
            total -= math.log(sum(float(p[end]) for end in ends))
            hits.append(max(float(p[end]) for end in ends) == float(p.max()))
            best = max(ends, key=lambda end: p[end])
            before += best
            left = {move for move in left if move[: len(before)] == before}
        expected.append(total)
    torch.testing.assert_close(found["loss_bc"].double(), torch.tensor(expected).double())
    assert float(found["accuracy"]) == pytest.approx(sum(hits) / len(hits))
    assert 0 < sum(hits) < len(hits)


def test_the_set_of_one_action_is_that_action():
    values, (data, _) = SpatialValues(Tables(), ACTIONS), moves_batch()
    one = data.clone()
    one["action"] = data["action"][:, 0]
    data["action"] = data["action"][:, :1].expand(-1, 5, -1)
    expected = LevelCrossEntropyLoss(values, "none")(one)
    found = LevelCrossEntropyLoss(values, "none", of_sets=True)(data)
    torch.testing.assert_close(dict(found), dict(expected))


@pytest.mark.parametrize("is_one_hot", [False, True])
def test_sets_of_a_single_level(is_one_hot):
    actor = QValueActor(nn.Linear(3, 4), action_space="one_hot" if is_one_hot else "categorical")
    moves, observation = torch.tensor([[0, 2, 0], [1, 1, 1]]), torch.rand(2, 3)
    action = nn.functional.one_hot(moves, 4) if is_one_hot else moves
    loss = LevelCrossEntropyLoss(actor, "none", of_sets=True)
    found, _ = loss(observation=observation, action=action)
    p = actor[0].module(observation).softmax(dim=-1)
    expected = -torch.stack([p[0, 0] + p[0, 2], p[1, 1]]).log()
    torch.testing.assert_close(found, expected)


def test_the_divergence_is_that_of_bernoulli_distributions():
    action = torch.tensor([[0.3, -0.7, 0.9], [0.0, 0.5, -0.99]], dtype=torch.float64)
    expert = torch.tensor([[-1.0, -0.7, 0.2], [1.0, 0.0, -1.0]], dtype=torch.float64)
    expected = 2 * kl_divergence(Bernoulli((1 + expert) / 2), Bernoulli((1 + action) / 2))
    found = action_distance(action, expert, "kl")
    torch.testing.assert_close(found, expected.mean(dim=-1), rtol=1e-6, atol=1e-9)
    assert (action_distance(action, action, "kl").abs() < 1e-12).all()


@pytest.mark.parametrize("expert", [-1.0, -0.3, 0.0, 1.0])
def test_the_gradient_of_the_divergence_before_the_tanh(expert):
    u = torch.linspace(-4, 4, 9, dtype=torch.float64, requires_grad=True)
    action_distance(u.tanh()[:, None], torch.full((9, 1), expert), "kl").sum().backward()
    torch.testing.assert_close(u.grad, 2 * (u.detach().tanh() - expert))


@pytest.mark.parametrize(("kind", "is_free"), [("mse", False), ("kl", True)])
def test_the_divergence_leaves_the_wrong_end_of_the_range(kind, is_free):
    loc = torch.full((4, 1), 12.0, requires_grad=True)  # tanh is 1 in float32
    sample = TanhNormal(loc, torch.full((4, 1), 0.1), low=-1.0, high=1.0).rsample()
    distance = action_distance(sample, torch.full((4, 1), -1.0), kind)
    assert distance.isfinite().all()
    distance.sum().backward()
    assert bool((loc.grad > 1).all()) is is_free
    assert bool((loc.grad.abs() < 1e-4).all()) is not is_free


@pytest.mark.parametrize("is_level", [False, True])
def test_masked_samples_do_not_count(is_level):
    data = batch()
    if is_level:
        loss = LevelCrossEntropyLoss(TwoLevels())
        data[keys.ACTION] = torch.tensor([[2.0, 0.0], [1.0, 1.0], [0.0, 1.0], [2.0, 1.0]])
    else:
        loss = BehaviourCloningLoss(squashed_gaussian_policy(Shifted(), OBSERVATION))
        data[keys.DEPTH] /= 2
    mask = torch.tensor([True, False, True, False])
    expected = dict(loss(data[mask]))
    data["collector", "mask"] = mask[:, None]
    torch.testing.assert_close(dict(loss(data)), expected)
    loss.loss_mask_key = None
    assert loss(data)["loss_bc"] != expected["loss_bc"]
