"""The steerable layer against escnn's own."""

import copy
import io
import pickle

import pytest
import torch

from ba_torchrl.modules.steerable.kernels import he_scales, kernel_block
from ba_torchrl.modules.steerable.layers import (
    DynamicSteerableConv2d,
    FilterGenerator,
    SteerableConv2d,
    SteerableLinear,
    reuse_filters,
)
from ba_torchrl.modules.steerable.planar import planar_rotations


def field_types(group, spec):
    named = {
        "regular": lambda: group.regular_repr,
        "trivial": lambda: group.trivial_repr,
        "vector": lambda: group.irrep(1),
        "quotient": lambda: group.quotient_repr(2),
    }
    return [(named[name](), count) for name, count in spec]


def escnn_twin(planar_escnn, ours, case):
    """escnn's layer with the coefficients and biases of ours."""
    order, *specs, _ = case
    space = planar_escnn.gspaces.rot2dOnR2(order)
    in_types, out_types = (field_types(space, spec) for spec in specs)

    def flat(types):
        return planar_escnn.nn.FieldType(space, [rep for rep, n in types for _ in range(n)])

    twin = planar_escnn.nn.R2Conv(
        flat(in_types),
        flat(out_types),
        ours.kernel_size,
        padding=ours.padding,
        stride=ours.stride,
        initialize=False,
    )
    # escnn orders the blocks by the names of their representations, in then out.
    pairs = sorted(
        (in_types[i][0].name, out_types[o][0].name, f"in{i}_out{o}")
        for i in range(len(in_types))
        for o in range(len(out_types))
        if f"in{i}_out{o}" in ours.coefficients
    )
    with torch.no_grad():
        twin.weights.copy_(torch.cat([ours.coefficients[name].flatten() for *_, name in pairs]))
        if ours.bias is not None:
            twin.bias.copy_(ours.bias)
    return twin


CASES = [
    (8, [("trivial", 2)], [("regular", 3)], 3),
    (8, [("regular", 3)], [("regular", 2)], 3),
    (4, [("regular", 2)], [("regular", 4)], 5),
    (6, [("regular", 2)], [("vector", 1), ("trivial", 8)], 1),
    (8, [("regular", 4), ("vector", 1), ("trivial", 3)], [("regular", 4)], 1),
    (8, [("vector", 2), ("trivial", 3)], [("trivial", 2), ("regular", 1)], 3),
    (2, [("regular", 2), ("vector", 2)], [("vector", 2), ("trivial", 1)], 3),
    (8, [("trivial", 3)], [("vector", 1), ("trivial", 2)], 1),  # trivial to vector: no kernel
    (8, [("regular", 3)], [("quotient", 2)], 1),
    (8, [("quotient", 2), ("trivial", 1)], [("regular", 2)], 5),
    (8, [("regular", 3)], [("regular", 2)], 4),
]


def build(case):
    order, inputs, outputs, kernel_size = case
    group = planar_rotations(order)
    types = field_types(group, inputs), field_types(group, outputs)
    stride = 2 if kernel_size == 4 else 1
    ours = SteerableConv2d(*types, kernel_size, padding=kernel_size // 2, stride=stride)
    with torch.no_grad():
        for bias in [ours.bias] if ours.bias is not None else []:
            bias.normal_()
    return ours, *types


@pytest.mark.parametrize("case", CASES, ids=str)
def test_forward_and_he_scales_equal_escnn(case):
    torch.manual_seed(0)
    planar_escnn = pytest.importorskip("profiling.planar_escnn")
    ours, in_types, out_types = build(case)
    twin = escnn_twin(planar_escnn, ours, case)
    x = torch.randn(2, twin.in_type.size, 9, 9)
    expected = twin(twin.in_type(x)).tensor
    torch.testing.assert_close(ours(x), expected, atol=1e-5, rtol=1e-5)
    # Filling our coefficients with their own standard deviations lines both layers up.
    with torch.no_grad():
        for (i, o), scale in he_scales(ours._blocks, in_types, out_types).items():
            weights = ours.coefficients[f"in{i}_out{o}"]
            weights.copy_(scale.expand_as(weights))
    expected = planar_escnn.nn.init._generalized_he_init_variances(twin.basisexpansion)
    actual = escnn_twin(planar_escnn, ours, case).weights.detach()
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_initial_coefficients_have_the_he_scale(device):
    torch.manual_seed(0)
    group = planar_rotations(8)
    types = [(group.regular_repr, 32)]
    with torch.device(device):
        layer = SteerableConv2d(types, types, 3)
        generator = FilterGenerator(4, DynamicSteerableConv2d(group.regular_repr, 2, 3))
    if device == "meta":  # torch's way to draw the parameters later
        for each in (layer, generator):
            each.to_empty(device="cpu").reset_parameters()
    assert all(each.isfinite().all() and each.any() for each in generator.parameters())
    (scale,) = he_scales(layer._blocks, types, types).values()
    measured = layer.coefficients["in0_out0"].detach().flatten(0, 1).std(dim=0)
    torch.testing.assert_close(measured, scale, rtol=0.15, atol=0)
    assert not layer.bias.any()


def test_copies_state_dict_and_pickle_carry_parameters_only():
    ours, *_ = build(CASES[4])
    x = torch.randn(2, 37, 5, 5)
    expected = ours(x)
    assert set(ours.state_dict()) == {name for name, _ in ours.named_parameters()}
    other = copy.deepcopy(ours)
    assert torch.equal(other(x), expected)
    stream = io.BytesIO(pickle.dumps(ours))
    assert torch.equal(pickle.load(stream)(x), expected)
    fresh, *_ = build(CASES[4])
    assert not torch.equal(fresh(x), expected)
    fresh.load_state_dict(ours.state_dict())
    assert torch.equal(fresh(x), expected)
    with torch.no_grad():
        other.coefficients["in0_out0"].zero_()
    assert torch.equal(ours(x), expected)


def test_bfloat16_input_computes_in_bfloat16_with_float32_gradients():
    ours, *_ = build(CASES[1])
    x = torch.randn(2, 24, 6, 6)
    out = ours(x.bfloat16())
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.float(), ours(x), atol=0.15, rtol=0.05)
    out.float().sum().backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in ours.parameters())


def test_linear_is_the_one_pixel_convolution():
    group = planar_rotations(8)
    types = [(group.regular_repr, 2)], [(group.irrep(1), 1), (group.trivial_repr, 2)]
    linear = SteerableLinear(*types)
    conv = SteerableConv2d(*types, 1)
    conv.load_state_dict(linear.state_dict())
    x = torch.randn(3, 2, 16)
    expected = conv(x.flatten(0, 1)[:, :, None, None])[:, :, 0, 0].unflatten(0, (3, 2))
    torch.testing.assert_close(linear(x), expected)


def test_blocks_are_shared_in_the_process():
    regular, again = (planar_rotations(8).regular_repr for _ in range(2))
    assert kernel_block(again, again, 3) is kernel_block(regular, regular, 3)


def test_bad_field_types_are_refused():
    group = planar_rotations(8)
    trivial, vector, regular = group.trivial_repr, group.irrep(1), group.regular_repr
    with pytest.raises(ValueError, match="each representation once"):
        SteerableConv2d([(regular, 1), (regular, 2)], [(regular, 1)], 3)
    with pytest.raises(ValueError, match="at least one"):
        SteerableConv2d([(regular, 0)], [(regular, 1)], 3)
    with pytest.raises(ValueError, match="no steerable kernel"):
        SteerableConv2d([(trivial, 1)], [(vector, 1)], 1)


@pytest.fixture
def layer():
    group = planar_rotations(4)
    types = field_types(group, [("regular", 2)])
    return SteerableConv2d(types, types, 3, padding=1)


@pytest.fixture
def expansions(layer, monkeypatch):
    """The dtypes of the filters that the layer has expanded."""
    expand, made = layer.expand, []

    def counted(dtype):
        made.append(dtype)
        return expand(dtype)

    monkeypatch.setattr(layer, "expand", counted)
    return made


@torch.no_grad()
def test_reused_filters_are_expanded_once_per_dtype_and_anew_afterwards(layer, expansions):
    x = torch.randn(2, 8, 5, 5)
    expected = layer(x)
    with reuse_filters():
        for _ in range(3):
            torch.testing.assert_close(layer(x), expected, rtol=0, atol=0)
            layer(x.bfloat16())
    assert expansions == [torch.float32, torch.float32, torch.bfloat16]
    for weight in layer.parameters():
        weight.data.mul_(2)
    torch.testing.assert_close(layer(x), 2 * expected)
    with reuse_filters():
        torch.testing.assert_close(layer(x), 2 * expected)


def test_reused_filters_belong_to_the_weights_of_a_functional_call(layer):
    x = torch.randn(2, 8, 5, 5)
    others = [
        {name: scale * weight.detach() for name, weight in layer.named_parameters()}
        for scale in (2, 3)
    ]
    with torch.no_grad(), reuse_filters():
        plain = layer(x)
        for _ in range(2):
            for scale, weights in zip((2, 3), others, strict=True):
                changed = torch.func.functional_call(layer, weights, (x,))
                torch.testing.assert_close(changed, scale * plain)
        torch.testing.assert_close(layer(x), plain, rtol=0, atol=0)


def test_forward_passes_with_gradients_do_not_reuse_filters(layer, expansions):
    x = torch.randn(2, 8, 5, 5)
    with reuse_filters():
        for _ in range(2):
            layer.zero_grad()
            layer(x).sum().backward()
            assert all(weight.grad is not None for weight in layer.parameters())
    assert len(expansions) == 2


@pytest.mark.slow
@torch.no_grad()
def test_a_layer_is_traced_as_one_graph(layer):
    x = torch.randn(2, 8, 5, 5)
    traced = torch.compile(layer, backend="eager", fullgraph=True)
    with reuse_filters():
        torch.testing.assert_close(traced(x), layer(x))
