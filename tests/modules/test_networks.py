"""Every registered actor-critic: sizes, shapes, precision, errors; parameters that are reset."""

import re

import pytest
import torch
from pydantic import ValidationError
from tensordict.nn import TensorDictModule
from torch import nn

from ba_torchrl.core.errors import BatchError, ConfigError
from ba_torchrl.modules import layers
from ba_torchrl.modules.base import NETWORKS, ActorCriticSpec
from ba_torchrl.modules.layers import compute_dtype
from ba_torchrl.modules.spatial.base import SpatialSpec
from tests.modules.networks import ACTOR_CRITICS, SPATIAL, actor_critic as small, count, spatial
from tests.specs import actor_critic_spec, spatial_spec


@pytest.mark.parametrize(
    ("name", "fields", "actor", "critic"),
    [
        ("equi", {}, 1_113_184, 1_178_970),
        ("equi", {"group_order": 4}, 557_152, None),
        ("cnn", {}, 1_278_874, 1_312_146),
    ],
)
def test_parameter_counts_match_the_paper(name, fields, actor, critic):
    networks = NETWORKS[name](**fields).build(actor_critic_spec(128, "pxyzr"))
    assert count(networks.actor) == actor
    if critic is not None:
        assert count(networks.encoder) + count(networks.critic) == critic


@pytest.mark.parametrize("leading", [(), (1,), (3,), (2, 3)], ids=str)
@pytest.mark.parametrize("sequence", ["pxyzr", "pxyz"])
@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_any_batch_shape(name, sequence, leading):
    networks = small(name, sequence=sequence)
    size = len(sequence)
    depth = torch.rand(*leading, 1, 64, 64)
    holding = torch.rand(*leading, 1) > 0.5
    action = torch.rand(*leading, size) * 2 - 1
    loc, scale = networks.actor(depth, holding)
    assert loc.shape == scale.shape == (*leading, size)
    assert (scale > 0).all()
    features = networks.encoder(depth, holding)
    assert features.shape[:-1] == leading
    values = networks.critic(features, action)
    assert values.shape == (*leading, 2)
    if len(leading) == 2:  # elements do not mix
        one = networks.critic(networks.encoder(depth[1, 2], holding[1, 2]), action[1, 2])
        torch.testing.assert_close(one, values[1, 2], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_outputs_depend_on_holding_and_action(name):
    networks = small(name)
    depth = torch.rand(1, 64, 64)
    held, free = torch.tensor([True]), torch.tensor([False])
    assert not torch.allclose(networks.actor(depth, held)[0], networks.actor(depth, free)[0])
    features = networks.encoder(depth, held)
    for component in range(5):
        action = torch.zeros(5)
        action[component] = 1
        values = networks.critic(features, action), networks.critic(features, torch.zeros(5))
        assert not torch.allclose(*values)
    assert values[0][0] != values[0][1]  # the twins are different functions


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_log_std_is_clamped(name):
    networks = small(name)
    with torch.no_grad():
        for parameter in networks.actor.parameters():
            parameter.mul_(30)
    _, scale = networks.actor(torch.rand(16, 1, 64, 64), torch.ones(16, 1, dtype=torch.bool))
    log_std = scale.log()
    assert log_std.max() <= 2 + 1e-5
    assert log_std.min() >= -20 - 1e-4
    assert torch.isclose(log_std, torch.tensor(2.0)).any() or (log_std < -19.9).any()


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_bfloat16_is_close_to_float32(name):
    exact = small(name)
    rough = small(name, precision="bfloat16")
    for one, other in zip(rough, exact, strict=True):
        one.load_state_dict(other.state_dict())
    depth, holding = torch.rand(8, 1, 64, 64), torch.rand(8, 1) > 0.5
    loc, scale = rough.actor(depth, holding)
    assert loc.dtype == scale.dtype == torch.float32
    expected = exact.actor(depth, holding)[0]
    assert (loc - expected).norm() < 0.05 * expected.norm()
    loc.sum().backward()
    assert {p.grad.dtype for p in rough.actor.parameters() if p.grad is not None} == {torch.float32}


INTEL = {"amx_bf16": True, "avx512_bf16": True, "cpu_name": "Intel Xeon"}
AMD = {"avx512_bf16": True, "cpu_name": "AMD Zen 4"}


@pytest.mark.parametrize("variable", ["ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"])
@pytest.mark.parametrize(
    ("flags", "allowed", "is_fast"),
    [
        ({"amx_bf16": True}, None, True),
        ({"avx512_bf16": True, "cpu_name": "Intel Xeon"}, None, False),
        ({"avx2": True, "amx_bf16": False}, None, False),
        *((INTEL, allowed, True) for allowed in (None, "DEFAULT", "avx512_core_amx")),
        (INTEL, "AVX10_1_512_AMX", True),
        *((INTEL, f"AVX512_CORE{end}", False) for end in ("_FP16", "_BF16", "")),
        *((AMD, allowed, True) for allowed in (None, "AVX512_CORE_FP16", "AVX512_CORE_BF16")),
        *((AMD, allowed, False) for allowed in ("AVX512_CORE", "AVX2")),
    ],
)
def test_auto_precision_uses_the_instructions_that_are_fast_and_allowed(
    flags, allowed, is_fast, variable, monkeypatch
):
    for name in ("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"):
        monkeypatch.delenv(name, raising=False)
    if allowed is not None:
        monkeypatch.setenv(variable, allowed)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: flags)
    layers._bfloat16_is_fast.cache_clear()
    cpu = torch.device("cpu")
    assert compute_dtype("auto", cpu) is (torch.bfloat16 if is_fast else torch.float32)
    layers._bfloat16_is_fast.cache_clear()
    assert compute_dtype("float32", cpu) is torch.float32
    assert compute_dtype("bfloat16", cpu) is torch.bfloat16
    assert compute_dtype("auto", torch.device("meta")) is torch.float32


@pytest.mark.parametrize(
    ("name", "fields"),
    [("cnn", {"widht": 2}), ("equi", {"precision": "float16"}), ("equi", {"group_order": 1})],
)
def test_unknown_fields_and_values_are_refused(name, fields):
    with pytest.raises(ValidationError):
        NETWORKS[name](**fields)


@pytest.mark.parametrize(
    ("name", "fields", "spec", "message"),
    [
        ("equi", {"n_hidden": 12}, (128, "pxyzr"), "multiple of 8 at 128 px"),
        ("equi", {"n_hidden": 6}, (64, "pxyzr"), "multiple of 4 at 64 px"),
        ("equi", {"n_hidden": 8}, (64, "pz"), "needs x and y"),
        ("equi", {"group_order": 2, "reflections": True}, (), "group_order of at least 3"),
        *(
            (name, {}, (90, "pxyzr"), r"64 or 128 px, got 90; set obs_size")
            for name in ACTOR_CRITICS
        ),
    ],
)
def test_what_cannot_be_built_is_refused(name, fields, spec, message):
    with pytest.raises(ValueError, match=message):
        NETWORKS[name](**fields).build(actor_critic_spec(*spec))


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((2, 1, 76, 76), torch.float32),
        ((2, 64, 64), torch.float32),
        ((2, 64, 64, 1), torch.float32),
        ((2, 1, 64, 64), torch.uint8),
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_images_for_which_a_network_was_not_built_are_refused(name, shape, dtype):
    message = re.escape(f"'depth' is {str(dtype)[6:]}{list(shape)}, and must be of a floating type")
    with pytest.raises(BatchError, match=message):
        small(name).actor(torch.zeros(shape, dtype=dtype), torch.zeros(2, 1))


def test_images_of_the_other_control_are_refused():
    depth, heights = actor_critic_spec(64, "pxyzr").images, spatial_spec().images
    with pytest.raises(ConfigError, match=r"images lack 'depth': .*; SpatialSpec takes heightmaps"):
        ActorCriticSpec(heights, "pxyzr")
    with pytest.raises(ConfigError, match=r"images lack .*; ActorCriticSpec takes depth images"):
        SpatialSpec(depth, ("x", "y"))


@pytest.mark.parametrize("sequence", ["", "pxx", "pxyq", 5])
def test_bad_action_sequences_are_refused(sequence):
    with pytest.raises(ValueError, match="action_sequence"):
        actor_critic_spec(64, sequence)


@pytest.mark.parametrize("name", [*ACTOR_CRITICS, "ensemble", *SPATIAL, "asr/pose"])
def test_parameters_that_are_reset_have_the_sizes_of_a_new_network(name):
    def build():
        if name in SPATIAL or "/" in name:
            return nn.ModuleList([spatial(name)])
        network, critics = ("equi", 3) if name == "ensemble" else (name, None)
        return nn.ModuleList(small(network, critics=critics))

    new, reset = build(), build()
    with torch.no_grad():
        for value in reset.parameters():
            value.add_(1000)
    torch.manual_seed(1)
    TensorDictModule(reset, [], []).reset_parameters_recursive()
    for (key, value), wanted in zip(reset.named_parameters(), new.parameters(), strict=True):
        if wanted.numel() < 200 or not wanted.any():
            assert value.abs().max() <= 4 * wanted.abs().max(), key
        else:
            assert value.std().item() == pytest.approx(wanted.std().item(), rel=0.3), key
            assert not torch.equal(value, wanted), key
