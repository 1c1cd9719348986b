"""The deictic network in six degrees of freedom under rotations of the scene."""

import pytest
import torch

pytest.importorskip("escnn")

from ba_torchrl.modules.base import NETWORKS
from tests.specs import spatial_spec

SIZE = 64
COMPONENTS = ("x", "y", "z", "rz", "ry", "rx")
FIELDS = {
    "width": 0.125,
    "precision": "float32",
    "num_rotations": 8,
    "num_z": 6,
    "num_tilts": 3,
    "height_scale_m": 0.05,
    "voxel_scale": 10.0,
}


def build(name="equi_deictic_asr", half_rotation=False, **fields):
    torch.manual_seed(0)
    return NETWORKS[name](**FIELDS, **fields).build(
        spatial_spec(SIZE, 24, 3, COMPONENTS, half_rotation)
    )


def batch(n=4, seed=0, yaws=8):
    """Rough heightmaps with values at many levels, in-hand images, and one choice each."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(n, 1, 16, 16, generator=generator) * 0.15
    pixels = coarse.repeat_interleave(4, -1).repeat_interleave(4, -2)
    holding = torch.arange(n)[:, None] % 2 == 0
    in_hand = torch.randint(24, (n, 3, 24, 24), generator=generator) * holding[..., None, None]
    limits = (SIZE, SIZE, yaws, 6, 3, 3)
    chosen = torch.stack([torch.randint(k, (n,), generator=generator) for k in limits], dim=1)
    return pixels, in_hand.float(), holding, chosen


def train(network, steps=4):
    """Take a few optimiser steps towards random targets, so that biases are not zero."""
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    before = [parameter.detach().clone() for parameter in network.parameters()]
    for step in range(steps):
        *observation, chosen = batch(seed=step + 10)
        values = values_of(network, observation, chosen)
        loss = sum((q - torch.rand_like(q)).square().mean() for q in values)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert all(not torch.equal(p, q) for p, q in zip(network.parameters(), before, strict=True))


def values_of(network, observation, chosen):
    first, state = network.first(*observation)
    return [first, *(network.later(n, state, chosen[:, : n + 1]) for n in range(1, 5))]


def turned(observation, chosen, quarters, yaw_steps):
    """The scene after quarter turns by torch.rot90, and the choices that rotate with it."""
    pixels, in_hand, holding = observation
    numbers = torch.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    position = torch.empty(SIZE * SIZE, dtype=torch.long)
    position[torch.rot90(numbers, quarters).flatten()] = torch.arange(SIZE * SIZE)
    pixel = position[chosen[:, 0] * SIZE + chosen[:, 1]]
    moved = chosen.clone()
    moved[:, 0], moved[:, 1] = pixel // SIZE, pixel % SIZE
    moved[:, 2] = (chosen[:, 2] + yaw_steps) % 8
    return (torch.rot90(pixels, quarters, (-2, -1)), in_hand, holding), moved


def spread(values):
    """Return the standard deviation of the values of a sample."""
    return float((values - values.mean(dim=-1, keepdim=True)).std())


def assert_equal(actual, expected):
    """Compare to a small part of the spread, since constants are equivariant as well."""
    assert spread(expected) > 1e-4
    torch.testing.assert_close(actual, expected, atol=5e-3 * spread(expected), rtol=0)


def assert_different(actual, expected):
    assert (actual - expected).std() > 0.03 * spread(expected)


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("quarters", [1, 2])
def test_rotating_the_scene_turns_pixels_shifts_yaws_and_keeps_the_other_values(quarters, trained):
    network = build()
    if trained:
        train(network)
    *observation, chosen = batch()
    with torch.no_grad():
        pixels, yaws, *others = values_of(network, observation, chosen)
        found = values_of(network, *turned(observation, chosen, quarters, 2 * quarters))
        assert_equal(found[0], torch.rot90(pixels, quarters, (-2, -1)))
        assert_equal(found[1], yaws.roll(2 * quarters, dims=1))
        for actual, expected in zip(found[2:], others, strict=True):
            assert_equal(actual, expected)
        # a yaw that does not rotate with the scene sees other projections
        other = values_of(network, *turned(observation, chosen, quarters, 0))
        for actual, expected in zip(other[2:], others, strict=True):
            assert_different(actual, expected)


@pytest.mark.parametrize("trained", [False, True])
def test_values_of_a_flattened_scene_are_invariant_for_fixed_features_only(trained):
    network = build(scene_head="flatten")
    if trained:
        train(network)
    *observation, chosen = batch()
    scene, moved = turned(observation, chosen, 1, 2)
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
    pixels, in_hand, holding = observation
    is_swapped = chosen[:, 2] >= 8
    # half a turn of the gripper: rows and columns of the axes y z, x z and x y
    reversed_hand = torch.stack(
        [in_hand[:, 0].flip(-2), in_hand[:, 1].flip(-2), in_hand[:, 2].flip(-2, -1)], dim=1
    )
    in_hand = torch.where(is_swapped[:, None, None, None], reversed_hand, in_hand)
    tilts = torch.where(is_swapped[:, None], 2 - chosen[:, 4:], chosen[:, 4:])
    chosen = torch.cat([chosen[:, :2], chosen[:, 2:3] % 8, chosen[:, 3:4], tilts], dim=1)
    return (pixels, in_hand, holding), chosen, is_swapped


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("quarters", [1, 2])
def test_yaws_of_half_a_turn(quarters, trained):
    """A yaw that leaves half a turn swaps the fingers: tilts and what is held turn over."""
    network = build(half_rotation=True)
    if trained:
        train(network)
    *observation, chosen = batch(n=6)
    scene, moved = turned(observation, chosen, quarters, 0)
    moved[:, 2] = chosen[:, 2] + 4 * quarters
    moved[:, 2] %= 16  # a full turn is the same pose
    swapped_scene, moved, is_swapped = wrapped(scene, moved)
    assert is_swapped.any()
    with torch.no_grad():
        pixels, yaws, *others = values_of(network, observation, chosen)
        found = values_of(network, scene, moved)[:2] + values_of(network, swapped_scene, moved)[2:]
        assert_equal(found[0], torch.rot90(pixels, quarters, (-2, -1)))
        assert_equal(found[1], yaws.roll(4 * quarters, dims=1))
        for actual, expected in zip(found[2:], others, strict=True):
            is_tilt = expected.shape[1] == 3
            turned_over = is_swapped[:, None] & torch.tensor(is_tilt)
            assert_equal(actual, torch.where(turned_over, expected.flip(1), expected))


def test_one_order_of_the_fingers_alone_is_not_symmetric():
    network = build(half_rotation=True, swap_fingers=False)
    *observation, chosen = batch()
    scene, moved = turned(observation, chosen, 2, 0)
    moved[:, 2] = chosen[:, 2] + 8
    scene, moved, _ = wrapped(scene, moved)
    with torch.no_grad():
        heights = values_of(network, observation, chosen)[2]
        assert_different(values_of(network, scene, moved)[2], heights)


def test_tilts_and_what_is_held_turn_over_with_the_fingers():
    """The symmetry does not hide either: each alone changes the values."""
    network = build(half_rotation=True)
    train(network)
    *observation, chosen = batch()
    chosen[:, 4] = 0
    tilted = chosen.clone()
    tilted[:, 4] = 2
    pixels, in_hand, holding = observation
    with torch.no_grad():
        expected = values_of(network, observation, chosen)[4]
        assert_different(values_of(network, observation, tilted)[4], expected)
        other = (pixels, in_hand.flip(-2), holding)
        assert_different(values_of(network, other, chosen)[4], expected)


def test_the_plain_network_is_not_equivariant():
    network = build("asr")
    *observation, chosen = batch()
    with torch.no_grad():
        values = values_of(network, observation, chosen)
        found = values_of(network, *turned(observation, chosen, 1, 2))
    assert_different(found[1], values[1].roll(2, dims=1))
    for actual, expected in zip(found[2:], values[2:], strict=True):
        assert_different(actual, expected)
