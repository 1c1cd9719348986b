import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.modules.chunks import ChunkFlow, ChunkHead, ChunkPolicy, chunk_head
from tests.modules.networks import actor_critic
from tests.modules.test_equivariance import CENTER_M, move_proprio, reflect_action, turn_action
from tests.specs import close_loop_images

T = 4


def turns(order):
    """Representations of C_order on (gripper, x, y)."""
    angles = 2 * math.pi * torch.arange(order) / order
    frames = torch.zeros(order, 3, 3)
    frames[:, 0, 0] = 1
    frames[:, 1, 1] = frames[:, 2, 2] = angles.cos()
    frames[:, 1, 2], frames[:, 2, 1] = -angles.sin(), angles.sin()
    return frames


@pytest.mark.parametrize("element", [1, 2, 5])
def test_the_chunk_turns_with_the_features(element):
    frames = turns(8)
    head = ChunkHead(6, frames, frames[:, 1:, 1:], T, hidden=16)
    features, vector, chunk = torch.randn(5, 6, 8), torch.randn(5, 2), torch.randn(5, T, 3)
    time, turn = torch.rand(5), frames[element]
    found = head(torch.cat([features.flatten(1), vector], -1), chunk, time)
    turned = features.roll(element, dims=-1).flatten(1)
    vector = vector @ turn[1:, 1:].T
    other = head(torch.cat([turned, vector], -1), chunk @ turn.T, time)
    torch.testing.assert_close(other, found @ turn.T, atol=1e-5, rtol=1e-5)
    assert (other - found).abs().max() > 1e-2


class Exact(nn.Module):
    """The clean chunk is the observation, from any noise."""

    horizon = T

    def forward(self, features, chunk, time):
        return features.unflatten(-1, (T, 1))


def observation(number, count):
    """A TensorDict [N], whose chunk counts up from 10 times the number of its environment."""
    first = torch.tensor(number)[:, None] * 10 + torch.tensor(count)[:, None]
    chunk = (first + torch.arange(T)) / 100
    return TensorDict(
        {"chunk": chunk.float(), keys.STEP_COUNT: torch.tensor(count)[:, None]}, [len(count)]
    )


def exact_policy(executed=2):
    return ChunkPolicy(ChunkFlow(nn.Identity(), Exact()), ["chunk"], 1, executed, seed=0)


def test_each_row_executes_its_own_chunk_across_resets():
    """Between the steps that begin a chunk, the observation does not matter."""
    policy, held = exact_policy(), {}
    rows = [([1, 2, 3], [0, 0, 0]), ([5, 6, 7], [1, 1, 1]), ([1, 2, 3], [2, 0, 2])]
    expected = [[0.10, 0.20, 0.30], [0.11, 0.21, 0.31], [0.12, 0.20, 0.32]]
    for (numbers, counts), actions in zip(rows, expected, strict=True):
        out = policy(observation(numbers, counts).update(held))
        assert out[keys.ACTION].squeeze(-1).tolist() == pytest.approx(actions)
        held = out.select(keys.CARRIED)
    out = policy(observation([4, 8, 9], [3, 1, 3]).update(held))
    assert out[keys.ACTION].squeeze(-1).tolist() == pytest.approx([0.13, 0.21, 0.33])


def test_without_the_rest_of_a_chunk_a_new_one_begins():
    out = exact_policy()(observation([1, 2], [1, 2]))
    assert out[keys.ACTION].squeeze(-1).tolist() == pytest.approx([0.11, 0.22])


@pytest.mark.parametrize("executed", [0, T + 1])
def test_more_actions_than_a_chunk_has_cannot_be_executed(executed):
    with pytest.raises(ValueError, match="executed must be between 1 and 4"):
        exact_policy(executed)


def random_policy(seed=0):
    torch.manual_seed(3)
    head = ChunkHead(2, torch.eye(1)[None], torch.zeros(1, 0, 0), T, hidden=8)
    return ChunkPolicy(ChunkFlow(nn.Identity(), head), ["x"], 1, 2, seed)


def test_the_noise_is_constant_unless_the_policy_explores():
    policy = random_policy()
    state = TensorDict({"x": torch.ones(3, 2), keys.STEP_COUNT: torch.zeros(3, 1).long()}, [3])
    rows = policy(state.clone())[keys.ACTION]
    assert (rows == rows[0]).all()
    assert not rows.requires_grad  # else a carried chunk would hold the graphs of all before it
    assert torch.equal(policy(state[:1].clone())[keys.ACTION], rows[:1])
    with set_exploration_type(ExplorationType.RANDOM):
        drawn, again = (random_policy(seed=5)(state.clone())[keys.ACTION] for _ in range(2))
        other = random_policy(seed=6)(state.clone())[keys.ACTION]
    assert len(drawn.unique()) == 3
    assert torch.equal(drawn, again)
    assert not torch.equal(drawn, other)


@pytest.mark.parametrize(
    ("name", "order", "reflections", "vectors"),
    [
        ("equi", 8, False, {}),
        ("equi", 4, True, {"proprio": 8}),
        ("equi", 2, False, {"proprio": 8}),
        ("equi_strided", 4, False, {}),
    ],
)
@torch.no_grad()
def test_the_chunk_of_a_turned_scene_is_the_turned_chunk(name, order, reflections, vectors):
    """Of the whole flow, whose noise turns, too."""
    fields = {"group_order": order, "vectors": vectors, "center_m": CENTER_M}
    fields |= {"reflections": True} if reflections else {}
    networks = actor_critic(name, sequence="pxyzr", **fields)
    spec = ActorCriticSpec(close_loop_images(64), "pxyzr", vectors=vectors)
    flow = ChunkFlow(networks.encoder, chunk_head(networks, spec, T, hidden=16), steps=2)
    flow.head.layers[-1].weight *= 0.1  # no action leaves its range
    depth, holding = torch.rand(2, 1, 64, 64), torch.tensor([[True], [False]])
    noise = 0.3 * torch.randn(2, T, 5)
    yaw = torch.tensor([0.3, -1.1])
    proprio = torch.rand(2, 8)
    proprio[:, 3:7] = torch.stack([(yaw / 2).cos(), (yaw / 2).sin(), 0 * yaw, 0 * yaw], dim=1)
    seen = [proprio] if vectors else []
    chunk = flow(depth, holding, *seen, noise)
    assert chunk.abs().max() < 1
    for quarters in range(4) if order > 2 else (0, 2):
        for flips in (False, True)[: 1 + reflections]:

            def move(action, quarters=quarters, flips=flips):
                action = reflect_action(action, "pxyzr") if flips else action
                return turn_action(action, "pxyzr", quarters)

            image = torch.rot90(depth.flip(-1) if flips else depth, quarters, (-2, -1))
            pose = [move_proprio(each, quarters, flips) for each in seen]
            moved = flow(image, holding, *pose, move(noise))
            torch.testing.assert_close(moved, move(chunk), atol=2e-5, rtol=1e-4)
    if name == "equi":  # the noise alone does not turn the chunk
        other = flow(depth, holding, *seen, turn_action(noise, "pxyzr", 2))
        assert not torch.allclose(other, chunk)


def test_a_network_without_frames_has_a_head_without_symmetry():
    networks = replace(actor_critic("cnn", vectors={"proprio": 8}), frames=None)
    spec = ActorCriticSpec(close_loop_images(64), "pxyzr", vectors={"proprio": 8})
    head = chunk_head(networks, spec, T)
    assert head.frames.shape == (1, 5, 5)
    assert head.vector_frames.numel() == 0
    features = networks.encoder(torch.rand(3, 1, 64, 64), torch.ones(3, 1) > 0, torch.rand(3, 8))
    assert head(features, torch.rand(3, T, 5), torch.rand(3)).shape == (3, T, 5)
