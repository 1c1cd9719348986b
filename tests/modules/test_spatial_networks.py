"""Every registered network with spatial Q values: sizes, shapes, precision, errors."""

import copy
import pickle

import pytest
import torch
from pydantic import ValidationError
from torchrl.objectives import LossModule

from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.modules.spatial.equi_unet import EquivariantPixelValues
from tests.modules.networks import SPATIAL, XY, XYR, batch, count, spatial as build, values_of
from tests.specs import slow_except, spatial_spec

EVERY = [*SPATIAL, "asr/pose", "equi_deictic_asr/pose", "equi_asr/flatten"]
EVERY += ["equi_deictic_asr/pose/flatten"]


@pytest.mark.parametrize("name", ["equi_fcn", "equi_asr", "equi_deictic_asr/pose"])
def test_values_of_both_heads_are_those_of_the_samples_head(name, monkeypatch):
    channels = 3 if "pose" in name else 1
    network, inputs = build(name, channels=channels), batch(channels=channels)
    fields, _ = network.first(*inputs[:3])
    weights = torch.randn(fields.shape, generator=torch.Generator().manual_seed(1))
    parameters = list(network.parameters())
    found = []
    for method in (EquivariantPixelValues._sorted_values, EquivariantPixelValues._selected_values):
        monkeypatch.setattr(EquivariantPixelValues, "_sorted_values", method)
        values = values_of(network, *inputs)[0]
        slopes = torch.autograd.grad((weights * values).sum(), parameters, materialize_grads=True)
        found.append([values, *slopes])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
    assert any(slope.any() for slope in found[0][1:])


# Weights layer by layer, added up by hand, with the biases behind them.
PLAIN_UNET = (
    (288 + 32 + 18_432)  # lift, R(32 -> 32)
    + (57_344 + 229_376 + 917_504)  # R(32 -> 64), R(64 -> 128), R(128 -> 256)
    + (3_670_016 + 131_072 + 256)  # R(256 -> 512), 1x1
    + (576 + 64) + (73_728 + 128) + (294_912 + 256)  # in-hand image
    + 1_900_544  # fuse
    + (1_900_544 + 32_768 + 128) + (475_136 + 8_192 + 64) + (118_784 + 2_048 + 32) + 29_696
)  # fmt: skip
IN_HAND_CONVS = (288 + 32) + (18_432 + 64) + (73_728 + 128) + (294_912 + 256)
GENERATOR = IN_HAND_CONVS + (9216 + 1) * 1024 + (1024 + 1) * (16 * 16 * 48 + 16)
EQUI_PIXELS = GENERATOR + 6_050_290
PLAIN_YAWS = (1_152 + 64) + (73_728 + 128) + (294_912 + 256) + 32_769 * 1024 + 1025 * 32
# C32: 7x7 kernels per pair of fields: 18 from a trivial one, 576; 3x3: 192. One bias per field.
YAW_CONVS = (8 * 18 + 8) + (8 * 16 * 576 + 16) + (16 * 32 * 576 + 32) + (32 * 32 * 192 + 32)
YAW_CONVS += (32 * 16 * 192 + 16) + (16 * 2 * 16 + 2)
YAW_FILTER = 1025 * (16 * 16 * 32 + 16)
POOLED_SCENE = (256 + 1) * 1024 + 1025 * 512  # maximum and mean of 128 channels
FLATTENED_SCENE = (256 * 8 * 8 + 1) * 1024 + 1025 * 512  # each of the 128 channels twice
EQUI_YAWS = YAW_CONVS + YAW_FILTER


def yaw_hand(last_map):
    return IN_HAND_CONVS + (256 * last_map**2 + 1) * 1024 + 1025 * 512


@pytest.mark.parametrize(
    ("name", "components", "in_hand_size", "first", "later"),
    [
        ("fcn", XY, 24, PLAIN_UNET + 66, 0),
        ("fcn", XYR, 24, PLAIN_UNET + 33 * 32, 0),
        ("rot_fcn", XYR, 24, PLAIN_UNET + 66, 0),
        ("equi_fcn", XY, 24, EQUI_PIXELS, 0),
        ("asr", XYR, 24, PLAIN_UNET + 66, PLAIN_YAWS),
        ("asr", XYR, 40, PLAIN_UNET + 66, PLAIN_YAWS),
        ("equi_asr", XYR, 24, EQUI_PIXELS, EQUI_YAWS + POOLED_SCENE + yaw_hand(6)),
        ("equi_asr/flatten", XYR, 24, EQUI_PIXELS, EQUI_YAWS + FLATTENED_SCENE + yaw_hand(6)),
    ],
)
def test_parameter_counts_match_the_reference(name, components, in_hand_size, first, later):
    network = build(name, 128, in_hand_size, components=components, width=1.0, num_rotations=16)
    parts = dict(network.named_children())
    assert count(parts.pop("values" if "values" in parts else "positions")) == first
    assert sum(map(count, parts.values())) == later


def test_dense_width_changes_the_hidden_fully_connected_layers_alone():
    fields = {"components": XYR, "width": 1.0, "num_rotations": 16}
    network = build("equi_asr", 128, dense_width=0.25, **fields)
    pixels = EQUI_PIXELS - GENERATOR + IN_HAND_CONVS + 9217 * 256 + 257 * (16 * 16 * 48 + 16)
    hand = IN_HAND_CONVS + 9217 * 256 + 257 * 128
    scene = 257 * 256 + 257 * 128
    assert count(network) == pixels + YAW_CONVS + 257 * (16 * 16 * 32 + 16) + hand + scene


def test_equi_fcn_with_yaws_has_the_size_of_the_reference():
    network = build("equi_fcn", 128, width=1.0, num_rotations=8)
    assert count(network) == 47_125_954  # 47.1 million at C16


@pytest.mark.parametrize(
    ("size", "in_hand_size", "half"),
    slow_except(
        [(32, 24, True), (32, 40, False), (128, 24, False)], [(32, 24, True), (32, 40, False)]
    ),
)
@pytest.mark.parametrize("name", SPATIAL)
def test_shapes_with_a_yaw(name, size, in_hand_size, half):
    network = build(name, size, in_hand_size, half=half)
    values = values_of(network, *batch(size, in_hand_size))
    assert len(values) == len(network.levels)
    components = []
    for level, q in zip(network.levels, values, strict=True):
        assert q.shape == (4, *level.shape)
        assert q.dtype == torch.float32
        assert torch.isfinite(q).all()
        components += level.components
    assert sorted(components) == ["rz", "x", "y"]
    assert all(n == (4 if c == "rz" else size) for level in network.levels
               for c, n in zip(level.components, level.shape, strict=True))  # fmt: skip


@pytest.mark.parametrize("name", ["fcn", "equi_fcn"])
def test_shapes_without_a_yaw(name):
    network = build(name, 48, components=XY)
    assert network.levels == ((("x", "y"), (48, 48)),)
    (values,) = values_of(network, *batch(48))
    assert values.shape == (4, 48, 48)


def test_rot_fcn_supports_ninety_pixels_as_in_the_paper():
    network = build("rot_fcn", 90, num_rotations=2)
    assert network.padded_size == 128
    (values,) = values_of(network, *batch(90, n=1))
    assert values.shape == (1, 2, 90, 90)


@pytest.mark.parametrize("name", EVERY)
def test_values_depend_on_every_input_and_on_their_own_sample_only(name):
    network = build(name, channels=3)
    heightmap, in_hand, holding, chosen = batch(channels=3)
    with torch.no_grad():
        values = values_of(network, heightmap, in_hand, holding, chosen)
        other = values_of(network, heightmap, in_hand, ~holding, chosen)
        for q, p in zip(values, other, strict=True):
            assert ((q - p).abs().flatten(1).amax(dim=1) > 1e-4 * q.std()).all()  # the primitive
        other = values_of(network, heightmap, in_hand.flip(-1) * 2, holding, chosen)
        for q, p in zip(values, other, strict=True):
            assert (q - p)[1].abs().max() > 1e-4 * q.std()  # what is held
        other = values_of(network, heightmap.flip(0), in_hand, holding, chosen)
        for q, p in zip(values, other, strict=True):
            assert (q - p).abs().max() > 1e-3 * q.std()
        for i in range(4):
            inputs = (each[i : i + 1] for each in (heightmap, in_hand, holding, chosen))
            alone = values_of(network, *inputs)
            for q, p in zip(values, alone, strict=True):
                assert (p[0] - q[i]).abs().max() < 1e-4 * q.std()


@pytest.mark.parametrize("name", ["equi_fcn", "equi_asr"])
def test_pick_values_do_not_depend_on_the_in_hand_image(name):
    network = build(name)
    heightmap, in_hand, holding, _ = batch()
    with torch.no_grad():
        values = network.first(heightmap, in_hand, holding)[0]
        other = network.first(heightmap, in_hand.flip(0) * 3, holding)[0]
    opened = ~holding[:, 0]
    assert torch.equal(values[opened], other[opened])
    assert not torch.allclose(values[~opened], other[~opened])


@pytest.mark.parametrize("primitive", [False, True])
@pytest.mark.parametrize("name", EVERY)
def test_a_batch_with_a_single_primitive_has_gradients(name, primitive):
    network = build(name)
    heightmap, in_hand, _, chosen = batch()
    holding = torch.full((4, 1), primitive)
    values = values_of(network, heightmap, in_hand, holding, chosen)
    sum(q.square().sum() for q in values).backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in network.parameters())
    some = [p for p in network.parameters() if p.grad is not None and p.grad.abs().sum() > 0]
    assert len(some) > 10


@pytest.mark.parametrize("seed", range(4))
@torch.no_grad()
def test_initial_values_of_narrow_networks_differ(seed):
    """Otherwise many pixels share the maximum, or the last layer of yaws has no gradient."""
    heightmap, in_hand, _, _ = inputs = batch()
    torch.manual_seed(seed)
    network = NETWORKS["equi_fcn"](width=0.125, precision="float32")
    network = network.build(spatial_spec(32, 24, 1, XY))
    for holding in (False, True):
        values, _ = network.first(heightmap, in_hand, torch.full((4, 1), holding))
        best, second = values.flatten(1).topk(2).values.unbind(1)
        assert (best > second).all()
    torch.manual_seed(seed)
    network = NETWORKS["equi_asr"](width=0.125, num_rotations=4, precision="float32")
    _, yaws = values_of(network.build(spatial_spec(32, 24, 1, XYR)), *inputs)
    assert (yaws.std(dim=1) > 1e-3 * yaws.abs().max()).all()


@pytest.mark.parametrize("name", ["asr", "equi_asr"])
def test_the_second_level_trains_the_encoder_of_the_first(name):
    network = build(name)
    values_of(network, *batch())[1].square().sum().backward()
    encoder = network.positions.unet.encoders[0]
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())
    assert network.positions.unet.decoders[-1].first.bias is None or (
        network.positions.unet.decoders[-1].first.bias.grad is None
    )


@pytest.mark.parametrize("name", ["asr", "equi_asr"])
def test_the_second_level_depends_on_the_chosen_pixel(name):
    network = build(name)
    heightmap, in_hand, holding, chosen = batch()
    with torch.no_grad():
        state = network.first(heightmap, in_hand, holding)[1]
        here, there = network.later(1, state, chosen), network.later(1, state, (chosen + 16) % 32)
    assert ((here - there).abs().amax(dim=1) > 1e-3 * here.std()).all()
    with pytest.raises(ValueError, match="later levels of this network are 1 to 1, got 2"):
        network.later(2, state, chosen)


def test_a_network_with_one_level_has_no_later_level():
    with pytest.raises(NotImplementedError, match="one level"):
        build("fcn").later(1, None, torch.zeros(4, 2, dtype=torch.long))


@pytest.mark.parametrize("name", EVERY)
def test_bfloat16_is_close_to_float32(name):
    exact, rough = build(name), build(name, precision="bfloat16")
    rough.load_state_dict(exact.state_dict())
    inputs = batch()
    pairs = list(zip(values_of(rough, *inputs), values_of(exact, *inputs), strict=True))
    for actual, expected in pairs:
        assert actual.dtype == torch.float32
        assert not torch.equal(actual, expected)
        assert (actual - expected).norm() < 0.05 * expected.norm()
    sum(q.sum() for q, _ in pairs).backward()
    assert {p.grad.dtype for p in rough.parameters() if p.grad is not None} == {torch.float32}


def test_values_of_bfloat16_networks_have_float32_resolution():
    """The heads are float32: bfloat16 has 128 different values between one and two."""
    for name in ("fcn", "equi_fcn"):
        network = build(name, precision="bfloat16", components=XY)
        biases = [p for n, p in network.named_parameters() if "head.b" in n or "values.b" in n]
        with torch.no_grad():
            for bias in biases:
                bias.add_(1.5)
        (values,) = values_of(network, *batch())
        one_to_two = values[(values > 1) & (values < 2)]
        assert one_to_two.numel() > 500
        assert one_to_two.unique().numel() > 500


@pytest.mark.parametrize("name", SPATIAL)
def test_scaled_heights_give_the_same_values(name):
    metres, units = build(name), build(name, height_scale_m=0.05)
    heightmap, in_hand, holding, chosen = batch()
    for expected, actual in zip(
        values_of(metres, heightmap, in_hand, holding, chosen),
        values_of(units, heightmap * 0.05, in_hand * 0.05, holding, chosen),
        strict=True,
    ):
        torch.testing.assert_close(
            actual, expected, atol=1e-4 * float(expected.detach().std()), rtol=1e-3
        )


@pytest.mark.parametrize("name", EVERY)
def test_copies_and_pickles_are_small_and_equal(name):
    """Policies are copied for evaluation and sent to processes that may lack escnn."""
    network, inputs = build(name), batch()
    data = pickle.dumps(network)
    assert b"escnn" not in data
    fresh = build(name)
    with torch.no_grad():
        for parameter in fresh.parameters():
            parameter.normal_()
    fresh.load_state_dict(network.state_dict())
    for other in (copy.deepcopy(network), pickle.loads(data), fresh):
        for q, p in zip(values_of(other, *inputs), values_of(network, *inputs), strict=True):
            assert torch.equal(q, p)


@pytest.mark.parametrize("name", EVERY)
def test_functional_calls_use_the_given_parameters(name):
    """TorchRL's target networks run the same module on other weights."""

    class Holder(LossModule):
        net: object
        net_params: object
        target_net_params: object

    holder = Holder()
    holder.convert_to_functional(build(name), "net", create_target_params=True)
    holder._has_update_associated["net"] = True
    inputs = batch()

    def values(params):
        with params.to_module(holder.net, preserve_module_state=False):
            return torch.cat([q.flatten() for q in values_of(holder.net, *inputs)])

    start = values(holder.net_params)
    start.square().sum().backward()
    assert all(p.grad is not None for p in holder.net_params.values(True, True))
    assert torch.equal(values(holder.target_net_params), start)
    with torch.no_grad():
        for value in holder.net_params.values(True, True):
            value.mul_(1.5)
    assert torch.equal(values(holder.target_net_params), start)
    assert not torch.allclose(values(holder.net_params), start)


@pytest.mark.parametrize("name", SPATIAL)
def test_unsupported_images_and_actions_are_refused(name):
    with pytest.raises(ValueError, match="x, y and rz, not z; use"):
        build(name, components=("x", "y", "z", "rz"))
    for wrong in ({"widht": 2}, {"width": 0.0}):
        with pytest.raises(ValidationError):
            NETWORKS[name](**wrong)
    message = "even obs_size" if name == "rot_fcn" else "obs_size that is a multiple of 16"
    with pytest.raises(ValueError, match=message):
        build(name, 91 if name == "rot_fcn" else 90)
    if name not in ("fcn", "equi_fcn"):
        with pytest.raises(ValueError, match="use 'fcn' or 'equi_fcn'"):
            build(name, components=XY)


def test_patches_and_in_hand_images_of_other_sizes():
    for name in ("asr", "equi_asr"):
        network = build(name, in_hand_size=32, patch_size=24)
        heightmap, in_hand, holding, chosen = batch(in_hand_size=32)
        state = network.first(heightmap, in_hand, holding)[1]
        assert network.later(1, state, chosen).shape == (4, 4)
        with pytest.raises(ValueError, match="even number of pixels"):
            build(name, in_hand_size=25, patch_size=24)
    with pytest.raises(ValueError, match="patch_size of 24 or 40"):
        build("equi_asr", in_hand_size=32)
    with pytest.raises(ValueError, match="4 to 55"):
        build("equi_fcn", in_hand_size=64)
    with pytest.raises(ValueError, match="at least 10"):
        build("fcn", in_hand_size=8)
    with pytest.raises(ValueError, match="leave out group_order"):
        build("equi_fcn", group_order=4)
