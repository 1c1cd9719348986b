import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from ba_torchrl.core import keys
from ba_torchrl.modules.chunks import ChunkFlow, ChunkHead
from ba_torchrl.objectives.flow import FlowMatchingLoss

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


def test_two_equal_goals_are_both_reached_and_not_their_mean():
    """Where the data has -0.8 and 0.8, regression gives 0."""
    flow, loss = make()
    goal = torch.where(torch.arange(64) % 2 == 0, 0.8, -0.8)[:, None, None].expand(64, T, A)
    data = TensorDict(
        {
            "x": torch.zeros(64, 5),
            keys.TARGET_CHUNK: goal,
            keys.TARGET_CHUNK_MASK: torch.ones(64, T, dtype=torch.bool),
        },
        [64],
    )
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    for _ in range(300):
        optimizer.zero_grad()
        loss(data)["loss_flow"].backward()
        optimizer.step()
    with torch.no_grad():
        chunks = flow(torch.zeros(200, 5), torch.randn(200, T, A))
    assert (chunks.abs() - 0.8).abs().mean() < 0.2
    first = chunks[:, 0, 0] > 0
    assert 0.3 < first.float().mean() < 0.7
    assert ((chunks > 0) == first[:, None, None]).float().mean() > 0.95  # one goal in a chunk
