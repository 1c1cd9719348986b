"""Every registered actor-critic: sizes, shapes, precision, errors."""

import copy
import pickle
import subprocess
import sys

import pytest
import torch
from pydantic import ValidationError
from torchrl.objectives import LossModule

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.layers import compute_dtype
from tests.specs import actor_critic_spec

pytest.importorskip("escnn")

ACTOR_CRITICS = [name for name in NETWORKS if NETWORKS[name].control == "close_loop"]

SMALL_EQUIVARIANT = {"n_hidden": 8, "group_order": 4}
SMALL = {
    "cnn": {"width": 0.25},
    "equi": SMALL_EQUIVARIANT,
    "equi_strided": SMALL_EQUIVARIANT,
}


def small(name, size=64, sequence="pxyzr", **fields):
    torch.manual_seed(0)
    return NETWORKS[name](**{**SMALL.get(name, {}), **fields}).build(
        actor_critic_spec(size, sequence)
    )


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_registry_holds_the_networks():
    assert {"cnn", "equi"} <= set(NETWORKS)


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
    networks = small(name, sequence=sequence, precision="float32")
    size = len(sequence)
    pixels = torch.rand(*leading, 1, 64, 64)
    holding = torch.rand(*leading, 1) > 0.5
    action = torch.rand(*leading, size) * 2 - 1
    loc, scale = networks.actor(pixels, holding)
    assert loc.shape == scale.shape == (*leading, size)
    assert (scale > 0).all()
    features = networks.encoder(pixels, holding)
    assert features.shape[:-1] == leading
    values = networks.critic(features, action)
    assert values.shape == (*leading, 2)
    if len(leading) == 2:  # elements do not mix
        one = networks.critic(networks.encoder(pixels[1, 2], holding[1, 2]), action[1, 2])
        torch.testing.assert_close(one, values[1, 2], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_outputs_depend_on_holding_and_action(name):
    networks = small(name, precision="float32")
    pixels = torch.rand(1, 64, 64)
    held, free = torch.tensor([True]), torch.tensor([False])
    assert not torch.allclose(networks.actor(pixels, held)[0], networks.actor(pixels, free)[0])
    features = networks.encoder(pixels, held)
    for component in range(5):
        action = torch.zeros(5)
        action[component] = 1
        values = networks.critic(features, action), networks.critic(features, torch.zeros(5))
        assert not torch.allclose(*values)
    assert values[0][0] != values[0][1]  # the twins are different functions


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_copies_and_pickles_are_small_and_equal(name):
    """Policies are copied for evaluation and sent to processes that may lack escnn."""
    networks = small(name, precision="float32")
    pixels, holding = torch.rand(1, 64, 64), torch.tensor([True])
    data = pickle.dumps(networks.actor)
    assert b"escnn" not in data
    assert len(data) < 4 * count(networks.actor) + 3e5
    for other in (copy.deepcopy(networks.actor), pickle.loads(data)):
        assert torch.equal(other(pixels, holding)[0], networks.actor(pixels, holding)[0])


@pytest.mark.parametrize("name", ACTOR_CRITICS)
def test_log_std_is_clamped(name):
    networks = small(name, precision="float32")
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
    exact = small(name, precision="float32")
    rough = small(name, precision="bfloat16")
    for one, other in zip(rough, exact, strict=True):
        one.load_state_dict(other.state_dict())
    pixels, holding = torch.rand(8, 1, 64, 64), torch.rand(8, 1) > 0.5
    loc, scale = rough.actor(pixels, holding)
    assert loc.dtype == scale.dtype == torch.float32
    expected = exact.actor(pixels, holding)[0]
    assert (loc - expected).norm() < 0.05 * expected.norm()
    loc.sum().backward()
    assert {p.grad.dtype for p in rough.actor.parameters() if p.grad is not None} == {torch.float32}


def test_auto_precision_follows_the_hardware(monkeypatch):
    from ba_torchrl.modules import layers

    cpu = torch.device("cpu")
    for variable in ("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"):
        monkeypatch.delenv(variable, raising=False)
    for flags, expected in [
        ({"amx_bf16": True}, torch.bfloat16),
        ({"amx_bf16": True, "avx512_bf16": True, "cpu_name": "Intel Xeon"}, torch.bfloat16),
        ({"avx512_bf16": True, "cpu_name": "AMD Zen 4"}, torch.bfloat16),
        ({"avx512_bf16": True, "cpu_name": "Intel Xeon"}, torch.float32),
        ({"avx2": True, "amx_bf16": False}, torch.float32),
    ]:
        layers._bfloat16_is_fast.cache_clear()
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda flags=flags: flags)
        assert compute_dtype("auto", cpu) is expected
    layers._bfloat16_is_fast.cache_clear()
    assert compute_dtype("float32", cpu) is torch.float32
    assert compute_dtype("bfloat16", cpu) is torch.bfloat16
    assert compute_dtype("auto", torch.device("meta")) is torch.float32


@pytest.mark.parametrize("variable", ["ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"])
@pytest.mark.parametrize(
    ("allowed", "with_amx", "on_amd"),
    [
        ("DEFAULT", torch.bfloat16, torch.bfloat16),
        ("avx512_core_amx", torch.bfloat16, torch.bfloat16),
        ("AVX10_1_512_AMX", torch.bfloat16, torch.bfloat16),
        ("AVX512_CORE_FP16", torch.float32, torch.bfloat16),
        ("AVX512_CORE_BF16", torch.float32, torch.bfloat16),
        ("AVX512_CORE", torch.float32, torch.float32),
        ("AVX2", torch.float32, torch.float32),
    ],
)
def test_auto_precision_uses_the_instructions_that_onednn_may_use(
    variable, allowed, with_amx, on_amd, monkeypatch
):
    from ba_torchrl.modules import layers

    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    monkeypatch.setenv(variable, allowed)
    intel = {"amx_bf16": True, "avx512_bf16": True, "cpu_name": "Intel Xeon"}
    amd = {"avx512_bf16": True, "cpu_name": "AMD Zen 4"}
    for flags, expected in [(intel, with_amx), (amd, on_amd)]:
        layers._bfloat16_is_fast.cache_clear()
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda flags=flags: flags)
        assert compute_dtype("auto", torch.device("cpu")) is expected
    layers._bfloat16_is_fast.cache_clear()


def test_functional_calls_use_the_given_parameters():
    """TorchRL's target networks run the same module on other weights."""

    class Holder(LossModule):
        net: object
        net_params: object
        target_net_params: object

    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule

    encoder = small("equi", precision="float32").encoder
    holder = Holder()
    module = TensorDictModule(encoder, ["pixels", "holding"], ["features"])
    holder.convert_to_functional(module, "net", create_target_params=True)
    holder._has_update_associated["net"] = True
    data = TensorDict({"pixels": torch.rand(2, 1, 64, 64), "holding": torch.ones(2, 1)}, [2])

    def features(params):
        with params.to_module(holder.net, preserve_module_state=False), torch.no_grad():
            return holder.net(data.clone())["features"]

    start = features(holder.net_params)
    assert torch.equal(features(holder.target_net_params), start)
    with torch.no_grad():
        for value in holder.net_params.values(True, True):
            value.mul_(2)
    assert torch.equal(features(holder.target_net_params), start)
    assert not torch.allclose(features(holder.net_params), start)


def test_config_errors():
    with pytest.raises(ValidationError):
        NETWORKS["cnn"](widht=2)
    with pytest.raises(ValidationError):
        NETWORKS["equi"](precision="float16")
    with pytest.raises(ValidationError):
        NETWORKS["equi"](group_order=1)
    with pytest.raises(ValueError, match="multiple of 8 at 128 px"):
        NETWORKS["equi"](n_hidden=12).build(actor_critic_spec(128, "pxyzr"))
    with pytest.raises(ValueError, match="multiple of 4 at 64 px"):
        NETWORKS["equi"](n_hidden=6).build(actor_critic_spec(64, "pxyzr"))
    with pytest.raises(ValueError, match="needs x and y"):
        NETWORKS["equi"](n_hidden=8).build(actor_critic_spec(64, "pz"))
    for name in ACTOR_CRITICS:
        with pytest.raises(ValueError, match=r"64 or 128 px, got 90; set obs_size"):
            NETWORKS[name]().build(actor_critic_spec(90, "pxyzr"))


@pytest.mark.parametrize("sequence", ["", "pxx", "pxyq"])
def test_bad_action_sequences_are_refused(sequence):
    with pytest.raises(ValueError, match="action_sequence"):
        actor_critic_spec(64, sequence)


def test_missing_escnn_names_the_fix():
    """The registry can be imported without escnn; building an equivariant network needs it."""
    code = """
import sys
sys.modules["escnn"] = None
from ba_torchrl.errors import MissingPackageError
from ba_torchrl.modules.base import NETWORKS
from tests.specs import actor_critic_spec, spatial_spec
actor_critic, spatial = actor_critic_spec(), spatial_spec()
NETWORKS["cnn"](width=0.1).build(actor_critic)
for name in ("fcn", "rot_fcn", "asr"):
    NETWORKS[name](width=0.1).build(spatial)
for name, spec in (("equi", actor_critic), ("equi_fcn", spatial), ("equi_asr", spatial)):
    try:
        NETWORKS[name]().build(spec)
    except MissingPackageError as error:
        assert "pip install --no-deps escnn==1.0.11" in str(error), error
        assert "make setup" in str(error), error
    else:
        raise SystemExit(f"built {name} without escnn")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
