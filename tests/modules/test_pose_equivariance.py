"""The deictic network in six degrees of freedom under rotations of the scene."""

import pytest
import torch

from tests.modules.networks import pose, pose_batch as batch, train, turned_pixels, values_of
from tests.tasks.episodes import slow

SIZE = 64


def build(name="equi_deictic_asr", half=False, trained=False, **fields):
    network = pose(name, half=half, height_scale_m=0.05, voxel_scale=10.0, **fields)
    if trained:
        train(network, batch)
    return network


def turned(observation, chosen, quarters, yaw_steps):
    """The scene after quarter turns by torch.rot90, and the choices that rotate with it."""
    heightmap, in_hand, holding = observation
    moved = torch.cat([turned_pixels(chosen, SIZE, quarters), chosen[:, 2:]], dim=1)
    moved[:, 2] = (chosen[:, 2] + yaw_steps) % 8
    return (torch.rot90(heightmap, quarters, (-2, -1)), in_hand, holding, moved)


def spread(values):
    """Return the standard deviation of the values of a sample."""
    return float((values - values.mean(dim=-1, keepdim=True)).std())


def assert_equal(actual, expected):
    """Compare to a small part of the spread, since constants are equivariant as well."""
    assert spread(expected) > 1e-4
    torch.testing.assert_close(actual, expected, atol=5e-3 * spread(expected), rtol=0)


def assert_different(actual, expected):
    assert (actual - expected).std() > 0.03 * spread(expected)


@pytest.mark.parametrize("trained", [*slow([False]), True])
@pytest.mark.parametrize("quarters", [1, 2])
def test_rotating_the_scene_turns_pixels_shifts_yaws_and_keeps_the_other_values(quarters, trained):
    network = build(trained=trained)
    *observation, chosen = batch()
    with torch.no_grad():
        pixels, yaws, *others = values_of(network, *observation, chosen)
        found = values_of(network, *turned(observation, chosen, quarters, 2 * quarters))
        assert_equal(found[0], torch.rot90(pixels, quarters, (-2, -1)))
        assert_equal(found[1], yaws.roll(2 * quarters, dims=1))
        for actual, expected in zip(found[2:], others, strict=True):
            assert_equal(actual, expected)
        # a yaw that does not rotate with the scene sees other projections
        other = values_of(network, *turned(observation, chosen, quarters, 0))
        for actual, expected in zip(other[2:], others, strict=True):
            assert_different(actual, expected)


@pytest.mark.parametrize("trained", [*slow([False]), True])
def test_values_of_a_flattened_scene_are_invariant_for_fixed_features_only(trained):
    network = build(scene_head="flatten", trained=trained)
    *observation, chosen = batch()
    *scene, moved = turned(observation, chosen, 1, 2)
    with torch.no_grad():
        _, state = network.first(*observation)
        _, rotated = network.first(*scene)
        for level in range(1, 5):
            expected = network.later(level, state, chosen[:, : level + 1])
            if level == 1:
                expected = expected.roll(2, dims=1)
            fixed = rotated._replace(scene=state.scene)
            assert_equal(network.later(level, fixed, moved[:, : level + 1]), expected)
            found = network.later(level, rotated, moved[:, : level + 1])
            assert (found - expected).abs().max() > 0.01 * spread(expected)


def wrapped(observation, chosen):
    """The same poses with the fingers swapped where the yaw has left half a turn."""
    heightmap, in_hand, holding = observation
    is_swapped = chosen[:, 2] >= 8
    # half a turn of the gripper: rows and columns of the axes y z, x z and x y
    reversed_hand = torch.stack(
        [in_hand[:, 0].flip(-2), in_hand[:, 1].flip(-2), in_hand[:, 2].flip(-2, -1)], dim=1
    )
    in_hand = torch.where(is_swapped[:, None, None, None], reversed_hand, in_hand)
    tilts = torch.where(is_swapped[:, None], 2 - chosen[:, 4:], chosen[:, 4:])
    chosen = torch.cat([chosen[:, :2], chosen[:, 2:3] % 8, chosen[:, 3:4], tilts], dim=1)
    return (heightmap, in_hand, holding), chosen, is_swapped


@pytest.mark.parametrize("trained", [*slow([False]), True])
@pytest.mark.parametrize("quarters", [1, 2])
def test_yaws_of_half_a_turn(quarters, trained):
    """A yaw that leaves half a turn swaps the fingers: tilts and what is held turn over."""
    network = build(half=True, trained=trained)
    *observation, chosen = batch(n=6)
    *scene, moved = turned(observation, chosen, quarters, 0)
    moved[:, 2] = chosen[:, 2] + 4 * quarters
    moved[:, 2] %= 16  # a full turn is the same pose
    swapped_scene, moved, is_swapped = wrapped(scene, moved)
    assert is_swapped.any()
    with torch.no_grad():
        pixels, yaws, *others = values_of(network, *observation, chosen)
        found = (
            values_of(network, *scene, moved)[:2] + values_of(network, *swapped_scene, moved)[2:]
        )
        assert_equal(found[0], torch.rot90(pixels, quarters, (-2, -1)))
        assert_equal(found[1], yaws.roll(4 * quarters, dims=1))
        for actual, expected in zip(found[2:], others, strict=True):
            is_tilt = expected.shape[1] == 3
            turned_over = is_swapped[:, None] & torch.tensor(is_tilt)
            assert_equal(actual, torch.where(turned_over, expected.flip(1), expected))


def test_one_order_of_the_fingers_alone_is_not_symmetric():
    network = build(half=True, swap_fingers=False)
    *observation, chosen = batch()
    *scene, moved = turned(observation, chosen, 2, 0)
    moved[:, 2] = chosen[:, 2] + 8
    scene, moved, _ = wrapped(scene, moved)
    with torch.no_grad():
        heights = values_of(network, *observation, chosen)[2]
        assert_different(values_of(network, *scene, moved)[2], heights)


def test_tilts_and_what_is_held_turn_over_with_the_fingers():
    """The symmetry does not hide either: each alone changes the values."""
    network = build(half=True, trained=True)
    *observation, chosen = batch()
    chosen[:, 4] = 0
    tilted = chosen.clone()
    tilted[:, 4] = 2
    heightmap, in_hand, holding = observation
    with torch.no_grad():
        expected = values_of(network, *observation, chosen)[4]
        assert_different(values_of(network, *observation, tilted)[4], expected)
        other = (heightmap, in_hand.flip(-2), holding)
        assert_different(values_of(network, *other, chosen)[4], expected)
