"""The SACfD loss on several views of each observation (DrQ)."""

import pytest
import torch

from ba_torchrl.envs import keys
from tests.linear_sac import batch, make

VIEWS, TARGET_VIEWS = 3, 2


def views_of(data, count, path=()):
    """Return views [count] of an observation: batches with different pixels."""
    generator = torch.Generator().manual_seed(count)
    views = []
    for _ in range(count):
        view = data.clone()
        noise = torch.rand(data[(*path, keys.PIXELS)].shape, generator=generator)
        view[(*path, keys.PIXELS)] += noise.double()
        views.append(view)
    return views


def with_views(data):
    """Return a batch with views, and its parts as batches with a single one."""
    states, followings = views_of(data, VIEWS), views_of(data, TARGET_VIEWS, (keys.NEXT,))
    out = data.clone()
    for key in (keys.PIXELS, keys.HOLDING):
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
    one_state = data.clone()
    one_state[keys.PIXELS], one_state[keys.HOLDING] = (
        states[0][keys.PIXELS],
        data[keys.HOLDING][:, 0],
    )
    assert torch.isfinite(make(target_views=TARGET_VIEWS)(one_state)["loss_qvalue"])
    one_target = data.clone()
    for key in (keys.PIXELS, keys.HOLDING):
        one_target[keys.NEXT, key] = followings[0][keys.NEXT, key]
    assert torch.isfinite(make(views=VIEWS)(one_target)["loss_qvalue"])
