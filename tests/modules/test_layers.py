"""Constants of a process; learners on a device without float64: the CPU is declared as one."""

import contextlib

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.modules import layers
from ba_torchrl.modules.spatial.projections import cell_table
from ba_torchrl.modules.steerable.kernels import kernel_block, regular_irrep_kernels
from ba_torchrl.modules.steerable.layers import reuse_filters
from tests.algorithms import tiny
from tests.modules.networks import actor_critic, batch, spatial, values_of


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


class Values(torch.nn.Module):
    """A spatial network as one function of its images and choices."""

    def __init__(self):
        super().__init__()
        self.network = spatial("equi_asr")

    def forward(self, *inputs):
        return tuple(values_of(self.network, *inputs))


def actor_and_inputs():
    heightmap, _, holding, _ = batch(size=64)
    return actor_critic("equi").actor, (heightmap, holding.float())


def values_and_inputs():
    return Values(), batch()


def clear():
    for each in (kernel_block, regular_irrep_kernels, layers.constants, cell_table):
        each.cache_clear()


def outputs_and_gradients(network, inputs):
    outputs = network(*inputs)
    network.zero_grad()
    sum(each.sum() for each in outputs).backward()
    return [*outputs, *(p.grad for p in network.parameters() if p.grad is not None)]


def export(network, inputs, strict=False):
    torch.export.export(network, inputs, strict=strict)


def fake(network, inputs):
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    with mode, torch.no_grad():
        network(*(mode.from_tensor(each) for each in inputs))


def transformed(network, inputs):
    parameters = dict(network.named_parameters())

    def total(parameters, *inputs):
        return sum(each.sum() for each in torch.func.functional_call(network, parameters, inputs))

    torch.func.grad(total)(parameters, *inputs)


def batched(network, inputs):
    rows = [each[:, None] for each in inputs]
    torch.func.vmap(network)(*rows)


def in_double_precision(network, inputs):
    try:
        network.double()(*(each.double() if each.is_floating_point() else each for each in inputs))
    finally:
        network.float()


def inside(*contexts):
    def run(network, inputs):
        with contextlib.ExitStack() as stack:
            for make in contexts:
                stack.enter_context(make())
            network(*inputs)

    return run


MODES = {
    "export": export,
    "fake": fake,
    "grad": transformed,
    "vmap": batched,
    "double": in_double_precision,
    "inference": inside(torch.inference_mode),
    "autocast": inside(lambda: torch.autocast("cpu", torch.bfloat16)),
}
REFUSED = {"fake", "vmap", "double"}
"""Modes in which a pass of the spatial network ends half-way with an error of torch."""
CONTEXTS = {
    "meta": lambda: torch.device("meta"),
    "fake": FakeTensorMode,
    "inference": torch.inference_mode,
}


@pytest.fixture(params=[actor_and_inputs, values_and_inputs], scope="module")
def ordinary(request):
    """A function that makes a network and its inputs, and what the network computes."""
    clear()
    return request.param, outputs_and_gradients(*request.param())


@pytest.mark.parametrize("mode", MODES)
def test_after_a_first_pass_in_a_mode_an_ordinary_one_computes_the_same(ordinary, mode):
    make, expected = ordinary
    clear()
    network, inputs = make()
    is_refused = make is values_and_inputs and mode in REFUSED
    with pytest.raises(RuntimeError) if is_refused else contextlib.nullcontext():
        MODES[mode](network, inputs)
    found = outputs_and_gradients(network, inputs)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("context", CONTEXTS)
def test_after_a_first_network_built_in_a_context_an_ordinary_one_computes_the_same(
    ordinary, context
):
    make, expected = ordinary
    clear()
    with CONTEXTS[context]():
        make()
    found = outputs_and_gradients(*make())
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("mode", ["export", "fake", "vmap", "inference", "autocast"])
def test_filters_that_are_kept_are_those_of_an_ordinary_pass(mode):
    network, inputs = actor_and_inputs()
    with torch.no_grad():
        expected = network(*inputs)
        with reuse_filters():
            MODES[mode](network, inputs)
            found = network(*inputs)
    torch.testing.assert_close(found, expected)
