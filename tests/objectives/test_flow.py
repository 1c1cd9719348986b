import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.chunks import ChunkFlow, ChunkHead, ChunkPolicy
from ba_torchrl.objectives.flow import FlowMatchingLoss
from ba_torchrl.objectives.imitation import BehaviourCloningLoss

T, A = 3, 2


def make(steps=8, **options):
    torch.manual_seed(0)
    head = ChunkHead(4, torch.eye(A)[None], torch.zeros(1, 0, 0), T, hidden=32)
    flow = ChunkFlow(nn.Linear(5, 4), head, steps)
    actor = TensorDictModule(flow, ["x", keys.NOISE], [keys.ACTION_CHUNK])
    return flow, FlowMatchingLoss(actor, **options)


def batch(n=6):
    generator = torch.Generator().manual_seed(1)
    length = torch.tensor([3, 1, 2, 3, 3, 0])[:n, None]
    return TensorDict(
        {
            "x": torch.randn(n, 5, generator=generator),
            keys.TARGET_CHUNK: torch.rand(n, T, A, generator=generator) * 2 - 1,
            keys.TARGET_CHUNK_MASK: torch.arange(T) < length,
        },
        [n],
    )


def by_hand(flow, data, draws):
    """The loss of each sample, one draw after the other."""
    noise, time = torch.randn(draws, len(data), T, A), torch.rand(draws, len(data))
    losses = []
    for row, sample in enumerate(data):
        total, count = 0.0, int(sample[keys.TARGET_CHUNK_MASK].sum())
        for draw in range(draws):
            t, clean = time[draw, row], sample[keys.TARGET_CHUNK]
            noisy = (1 - t) * noise[draw, row] + t * clean
            found = flow.head(flow.encoder(sample["x"]), noisy, t)
            for step in range(count):
                total += (found[step] - clean[step]).square().sum().item() / A / count / draws
        losses.append(total)
    return losses


@pytest.mark.parametrize("draws", [1, 4])
def test_the_error_is_that_of_the_clean_chunk_in_the_steps_that_count(draws):
    flow, loss = make(draws=draws, reduction="none")
    data = batch()
    torch.manual_seed(7)
    found = loss(data)["loss_flow"]
    torch.manual_seed(7)
    assert found.tolist() == pytest.approx(by_hand(flow, data, draws), rel=1e-4)
    assert found[-1] == 0
    for reduction, total in (("mean", found.mean()), ("sum", found.sum())):
        torch.manual_seed(7)
        other = make(draws=draws, reduction=reduction)[1]
        torch.manual_seed(7)
        torch.testing.assert_close(other(data)["loss_flow"], total)


def test_masked_samples_do_not_count():
    _, loss = make(reduction="sum")
    data = batch()
    data["collector", "mask"] = torch.arange(6)[:, None] != 2
    torch.manual_seed(7)
    found = loss(data)["loss_flow"]
    torch.manual_seed(7)
    each = make(reduction="none")[1]
    torch.manual_seed(7)
    del data["collector"]
    each = each(data)["loss_flow"]
    torch.testing.assert_close(found, each.sum() - each[2])


def learned(loss, data, steps=300):
    """Minimise a loss."""
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    for _ in range(steps):
        optimizer.zero_grad()
        sum(loss(data).values()).backward()
        optimizer.step()


@torch.no_grad()
def ends(policy, n=200):
    """Play a task: goals at -1 and 1 are equally far from the start at 0, and four steps away."""
    x, carried = torch.zeros(n, 1), TensorDict({}, [n])
    for step in range(4):
        state = TensorDict({"x": x, keys.STEP_COUNT: torch.full((n, 1), step)}, [n])
        out = policy(state.update(carried))
        x = x + 0.25 * out[keys.ACTION]
        carried = out.select(keys.CARRIED, strict=False)
    return x.squeeze(-1)


def test_one_of_two_equal_goals_is_reached_where_cloning_stays_between_them():
    torch.manual_seed(0)
    side = torch.tensor([-1.0, 1.0]).repeat_interleave(4)[:, None]
    data = {"x": side * (torch.arange(8) % 4)[:, None] / 4, keys.ACTION: 0.95 * side}
    data |= {keys.TARGET_CHUNK: (0.95 * side)[:, None].expand(8, 2, 1)}
    data |= {keys.TARGET_CHUNK_MASK: torch.ones(8, 2, dtype=torch.bool)}
    data = TensorDict(data, [8]).repeat(8)
    head = ChunkHead(4, torch.eye(1)[None], torch.zeros(1, 0, 0), 2, hidden=64)
    chunks = ChunkPolicy(ChunkFlow(nn.Linear(1, 4), head), ["x"], 1, executed=2, seed=0)
    learned(FlowMatchingLoss(chunks.flow), data)
    with set_exploration_type(ExplorationType.RANDOM):
        reached = ends(chunks)
    assert (reached.abs() > 0.6).float().mean() > 0.85
    assert 0.3 < (reached > 0).float().mean() < 0.7
    layers = nn.Sequential(nn.Linear(1, 32), nn.SiLU(), nn.Linear(32, 2), NormalParamExtractor())
    clone = squashed_gaussian_policy(layers, ["x"])
    learned(BehaviourCloningLoss(clone), data)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert ends(clone).abs().max() < 0.2
