"""TorchRL's private names that the vector of environments uses, and the vector without them."""

import pytest
import torch
from torchrl.envs import ParallelEnv

from ba_torchrl import make_vector_env
from ba_torchrl.envs.vector import torchrl_names


@pytest.fixture
def started():
    env = make_vector_env("close_loop/block_reaching", 2, start_method="fork", seed=3, obs_size=16)
    yield env
    env.close()


def test_torchrl_has_every_name():
    assert torchrl_names.missing_names.__wrapped__() == ()


def test_a_vector_has_the_listed_attributes(started):
    names = [*torchrl_names.METHODS, *torchrl_names.ATTRIBUTES]
    assert [name for name in names if not hasattr(started, name)] == []


@pytest.mark.parametrize("group", ["MODULE_NAMES", "METHODS", "ATTRIBUTES"])
def test_a_name_that_goes_is_named(group, monkeypatch):
    gone = {"torchrl.envs.batched_envs": ("_gone",)} if group == "MODULE_NAMES" else ("_gone",)
    monkeypatch.setattr(torchrl_names, group, gone)
    (missing,) = torchrl_names.missing_names.__wrapped__()
    assert missing.endswith("._gone")


def test_without_them_the_vector_is_a_plain_one_with_the_same_episodes(started, monkeypatch):
    monkeypatch.setattr("ba_torchrl.envs.vector.make.missing_names", lambda: ("_gone",))
    options = {"start_method": "fork", "seed": 3, "obs_size": 16}
    with pytest.warns(UserWarning, match=r"lacks _gone.*does not replace workers"):
        plain = make_vector_env("close_loop/block_reaching", 2, **options)
    try:
        assert isinstance(plain, ParallelEnv)
        for env in (started, plain):
            env.set_seed(7)
        first, second = started.reset(), plain.reset()
        torch.testing.assert_close(first["pixels"], second["pixels"], rtol=0, atol=0)
        assert not torch.equal(second["pixels"][0], second["pixels"][1])
        plain.continue_from(started.get_positions())  # of a run that is resumed
        torch.testing.assert_close(
            started.reset(seed=5)["pixels"], plain.reset(seed=5)["pixels"], rtol=0, atol=0
        )
    finally:
        plain.close()
