"""Constants of a process; learners on a device without float64: the CPU is declared as one."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.modules import layers
from tests.algorithms import tiny


class NoFloat64(TorchDispatchMode):
    """Refuses operations whose result is of type float64."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        assert getattr(result, "dtype", None) != torch.float64, func
        return result


def learn_and_act(learner, batch):
    learner.loss(batch)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        return learner.policy(batch.select(*learner.observation_keys))["action"]


@pytest.fixture
def without_float64(monkeypatch):
    def declare():
        monkeypatch.setattr(layers, "WITHOUT_FLOAT64", {"cpu"})
        layers.constants.cache_clear()

    yield declare
    layers.constants.cache_clear()


@pytest.mark.parametrize(
    ("algorithm", "network", "sequence", "settings"),
    [
        ("sac", "cnn", None, {}),
        ("sac", "equi", None, {}),
        ("spatial_q", "asr", None, {}),
        ("spatial_q", "asr", None, {"imitation": {"name": "adet"}}),
        ("spatial_q", "asr", tiny.SIX_DOF, {}),
        ("spatial_q", "equi_deictic_asr", None, {}),
    ],
)
def test_learners(algorithm, network, sequence, settings, without_float64):
    learner = tiny.build(algorithm, network, sequence=sequence, batch_size=4, **settings)
    learner.extend(tiny.transitions(learner))
    batch = learner.sample()
    expected = learn_and_act(learner, batch.clone())  # tables of rotations exist afterwards
    without_float64()
    with NoFloat64():
        action = learn_and_act(learner, batch.clone())
    torch.testing.assert_close(action, expected, rtol=0, atol=1e-6)


def make_constant(calls):
    @layers.cached_constant(maxsize=2)
    def powers(base: float, count: int) -> torch.Tensor:
        calls.append((base, count))
        return base ** torch.arange(count)

    return powers


def test_a_constant_is_computed_once_for_the_same_arguments():
    calls = []
    powers = make_constant(calls)
    first = powers(2.0, 3)
    assert first.tolist() == [1.0, 2.0, 4.0]
    assert powers(2.0, 3) is first
    assert powers(3.0, 2).tolist() == [1.0, 3.0]
    assert calls == [(2.0, 3), (3.0, 2)]
    powers(3.0, 3)  # in place of the oldest
    powers(3.0, 2)
    assert len(calls) == 3
    powers(2.0, 3)
    assert calls[3:] == [(2.0, 3)]
    powers.cache_clear()
    powers(2.0, 3)
    assert len(calls) == 5


def test_a_constant_of_inference_mode_can_be_used_in_training():
    powers = make_constant([])
    with torch.inference_mode():
        first = powers(2.0, 3)
    weight = torch.ones(3, requires_grad=True)
    (weight * powers(2.0, 3)).sum().backward()
    assert weight.grad.tolist() == [1.0, 2.0, 4.0]
    assert powers(2.0, 3) is first
