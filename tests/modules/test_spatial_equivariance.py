"""Networks with spatial Q values under turns, flips and shifts of the scene."""

import pytest
import torch

from tests.modules.networks import XY, XYR, batch, spatial, train, turned_pixels
from tests.tasks.episodes import slow

SIZE = 32


def build(name, components=XYR, half=True, size=SIZE, trained=False, **fields):
    network = spatial(name, size, components=components, half=half, **fields)
    if trained:
        train(network)
    return network


def assert_equal(actual, expected):
    """Compare to 1e-4 of the spread of the values, since constants are equivariant as well."""
    spread = float(expected.std())
    assert spread > 1e-4
    torch.testing.assert_close(actual, expected, atol=1e-4 * spread, rtol=1e-4)


CASES = [
    ("equi_fcn", XY, True, {}),
    ("equi_fcn", XYR, True, {"num_rotations": 6}),
    ("equi_fcn", XYR, False, {"num_rotations": 8}),
    ("equi_asr", XYR, True, {"num_rotations": 6}),
    ("equi_asr", XYR, False, {"num_rotations": 8}),
    ("equi_asr", XYR, True, {"num_rotations": 4, "patch_size": 40}),
]


@torch.no_grad()
def under_a_quarter_turn(network, shift):
    """Return the values of each level on turned images, and those on the images, turned.

    A quarter turn shifts the yaws by ``shift``.
    """
    heightmap, in_hand, holding, chosen = batch()
    first, state = network.first(heightmap, in_hand, holding)
    turned, turned_state = network.first(torch.rot90(heightmap, 1, (-2, -1)), in_hand, holding)
    expected = torch.rot90(first, 1, (-2, -1))
    if network.levels[0].components[0] == "rz":
        expected = expected.roll(shift, dims=1)
    levels = [(turned, expected)]
    if len(network.levels) == 2:
        yaws = network.later(1, state, chosen)
        turned_yaws = network.later(1, turned_state, turned_pixels(chosen, SIZE))
        levels.append((turned_yaws, yaws.roll(shift, dims=1)))
    return levels


@pytest.mark.parametrize("trained", [*slow([False]), True])
@pytest.mark.parametrize(("name", "components", "half", "fields"), CASES)
def test_a_quarter_turn_turns_pixels_and_shifts_yaws(name, components, half, fields, trained):
    network = build(name, components, half, **fields, trained=trained)
    shift = fields.get("num_rotations", 4) // (2 if half else 4)
    levels = under_a_quarter_turn(network, shift)
    for turned, expected in levels:
        assert_equal(turned, expected)
    if len(levels) == 2:
        yaws, expected = levels[1]
        # What tells the yaws apart may be small beside what tells the pixels apart.
        mean = expected.mean(dim=1, keepdim=True)
        assert_equal(yaws - mean, expected - mean)
        wrong = yaws - expected.roll(1, dims=1)
        assert wrong.std() > 0.1 * (expected - mean).std()


@pytest.mark.parametrize("trained", [*slow([False]), True])
def test_yaws_of_a_flattened_scene_are_equivariant_for_fixed_features_only(trained):
    network = build("equi_asr", num_rotations=6, scene_head="flatten", trained=trained)
    heightmap, in_hand, holding, chosen = batch()
    with torch.no_grad():
        state = network.first(heightmap, in_hand, holding)[1]
        expected = network.later(1, state, chosen).roll(3, dims=1)
        turned = network.first(torch.rot90(heightmap, 1, (-2, -1)), in_hand, holding)[1]
        moved = turned_pixels(chosen, SIZE)
        assert_equal(network.later(1, turned._replace(scene=state.scene), moved), expected)
        difference = network.later(1, turned, moved) - expected
    assert difference.std() > 0.01 * expected.std()  # a hundred times the tolerance


@pytest.mark.parametrize("trained", [*slow([False]), True])
@pytest.mark.parametrize(("name", "components", "half", "fields"), CASES)
def test_quarter_turns_in_bfloat16_are_exact_up_to_its_rounding(
    name, components, half, fields, trained
):
    network = build(name, components, half, **{**fields, "precision": "bfloat16"}, trained=trained)
    shift = fields.get("num_rotations", 4) // (2 if half else 4)
    levels = under_a_quarter_turn(network, shift)
    if len(levels) == 2:  # also the differences between yaws alone
        levels.append(tuple(yaws - yaws.mean(dim=1, keepdim=True) for yaws in levels[1]))
    for turned, expected in levels:
        assert (turned - expected).std() < 0.02 * expected.std()


@pytest.mark.parametrize("trained", [*slow([False]), True])
@pytest.mark.parametrize("name", ["equi_fcn", "equi_asr"])
def test_flips_of_the_image_flip_the_pixels_values(name, trained):
    network = build(name, XY if name == "equi_fcn" else XYR, trained=trained)
    heightmap, in_hand, holding, _ = batch()
    with torch.no_grad():
        values = network.first(heightmap, in_hand, holding)[0]
        for dim in (-2, -1):
            flipped = network.first(heightmap.flip(dim), in_hand, holding)[0]
            assert_equal(flipped, values.flip(dim))


@pytest.mark.parametrize(("half", "num_rotations"), [(True, 6), (False, 8)])
def test_rot_fcn_sees_each_yaw_in_its_own_frame(half, num_rotations):
    """Rotating the scene shifts the yaws; beyond half a turn, views are rotated by 180 degrees."""
    network = build("rot_fcn", half=half, size=26, num_rotations=num_rotations)
    heightmap, in_hand, holding, _ = batch(size=26)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))  # biases, too
        values = network.first(heightmap, in_hand, holding)[0]
        turned = network.first(torch.rot90(heightmap, 1, (-2, -1)), in_hand, holding)[0]
    expected = torch.rot90(values, 1, (-2, -1)).roll(num_rotations // (2 if half else 4), dims=1)
    assert_equal(turned[:, num_rotations // 2 :], expected[:, num_rotations // 2 :])
    if not half:
        assert_equal(turned, expected)


def test_rot_fcn_rotates_the_image_against_the_yaw():
    """A gripper at +90 degrees sees the scene rotated by -90; its values are rotated back."""
    network = build("rot_fcn", half=False, size=26, num_rotations=4)
    heightmap, in_hand, holding, _ = batch(size=26)
    assert network.padded_size == 48
    padded = torch.nn.functional.pad(heightmap, (11,) * 4)
    with torch.no_grad():
        values = network.first(heightmap, in_hand, holding)[0]
        for index in range(4):
            view = torch.rot90(padded, -index, (-2, -1))
            expected = network.values(view, in_hand, holding)[0][:, 0]
            expected = torch.rot90(expected, index, (-2, -1))[:, 11:-11, 11:-11]
            assert_equal(values[:, index], expected)


@pytest.mark.parametrize(
    ("name", "components", "fields"),
    [
        ("fcn", XY, {}),
        ("fcn", XYR, {"num_rotations": 3}),
        ("equi_fcn", XY, {}),
        ("equi_fcn", XYR, {"num_rotations": 2}),
        ("asr", XYR, {"num_rotations": 2}),
        ("equi_asr", XYR, {"num_rotations": 4}),
    ],
)
def test_a_shift_by_the_stride_shifts_the_values(name, components, fields):
    """Without biases an empty floor gives zeros, and the receptive field lies within the image."""
    size = 288
    network = build(name, components, size=size, **{"width": 1 / 16, **fields})
    with torch.no_grad():
        for parameter_name, parameter in network.named_parameters():
            if parameter_name.endswith("bias") and "coefficients" not in parameter_name:
                parameter.zero_()  # the dynamic filter's coefficients stay
    heightmap = torch.zeros(1, 1, size, size)
    heightmap[..., 136:148, 140:150] = torch.rand(12, 10)
    moved = heightmap.roll((16, -16), dims=(-2, -1))
    in_hand, holding = torch.zeros(1, 1, 24, 24), torch.tensor([[name.startswith("equi")]])
    with torch.no_grad():
        values, state = network.first(heightmap, in_hand, holding)
        shifted, shifted_state = network.first(moved, in_hand, holding)
        assert_equal(shifted, values.roll((16, -16), dims=(-2, -1)))
        if name == "equi_asr":  # the plain one's yaws depend on where in the image they are
            chosen = torch.tensor([[140, 146]])
            yaws = network.later(1, state, chosen)
            shifted_yaws = network.later(1, shifted_state, chosen + torch.tensor([16, -16]))
            assert_equal(shifted_yaws, yaws)
        half_stride = network.first(heightmap.roll(3, dims=-1), in_hand, holding)[0]
    assert (half_stride - values.roll(3, dims=-1)).abs().max() > 1e-3 * values.abs().max()
