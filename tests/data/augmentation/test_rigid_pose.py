"""Rigid transforms of actions with tilts and of projections of what is held."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict

from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.data.augmentation.rigid import RigidAugmentation
from ba_torchrl.modules.spatial.base import Level
from ba_torchrl.modules.spatial.policy import SpatialActions
from ba_torchrl.sim.geometry import euler_matrix
from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView
from tests.specs import open_loop_images

BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
SIZE = 64
CENTER = (0.45, 0.0)
SWAP = np.diag([-1.0, -1.0, 1.0])
"""Half a turn about the tool's own axis."""


def augmentation(transforms, half_rotation=True, **settings):
    actions = OpenLoopActions("pxyzrrr", BOUNDS, half_rotation)
    return RigidAugmentation(transforms, actions, open_loop_images(SIZE, 24, 3), seed=0, **settings)


def transitions(heightmap, actions, in_hand):
    count = len(actions)
    images = {
        "heightmap": torch.from_numpy(heightmap).float().expand(count, 1, -1, -1),
        "in_hand": torch.from_numpy(in_hand).float().expand(count, -1, -1, -1),
    }
    following = {key: value.clone() for key, value in images.items()}
    return TensorDict({**images, "action": actions, "next": following}, batch_size=[count])


def spot():
    """A heightmap with a smooth bump 10 cm from the centre along x."""
    steps = (np.arange(SIZE) + 0.5) * 0.4 / SIZE - 0.2
    return np.exp(-((steps[:, None] - 0.1) ** 2 + steps**2) / (2 * 0.03**2))


def place_of(image):
    """Return the position of the bump relative to the centre, metres."""
    steps = (torch.arange(SIZE) + 0.5) * 0.4 / SIZE - 0.2
    weight = image[0] / image.sum()
    return float((weight.sum(1) * steps).sum()), float((weight.sum(0) * steps).sum())


@pytest.mark.parametrize("half_rotation", [True, False])
@pytest.mark.parametrize(("transforms", "order"), [("cn", 16), ("cn", 5), ("se2", 1)])
def test_the_pose_rotates_with_the_scene(transforms, order, half_rotation):
    """The tool's rotation is turned about z, with the fingers swapped where the yaw is wrapped."""
    rng = np.random.default_rng(0)
    poses = rng.uniform((0.0, -0.4, -0.4), (math.pi, 0.4, 0.4), (60, 3))
    action = np.concatenate(
        [rng.integers(2, size=(60, 1)), np.tile([[0.55, 0.0, 0.07]], (60, 1)), poses], axis=1
    )
    data = transitions(spot(), torch.from_numpy(action).float(), np.zeros((3, 24, 24)))
    out = augmentation(transforms, half_rotation, order=order)(data)
    swapped = 0
    for image, before, after in zip(
        out["heightmap"], action, out["action"].double().numpy(), strict=True
    ):
        x, y = place_of(image)
        assert after[[0, 3]] == pytest.approx(before[[0, 3]], abs=1e-6)  # primitive and z
        np.testing.assert_allclose(after[1:3] - CENTER, (x, y), atol=2e-3)
        assert 0 <= after[4] <= (math.pi if half_rotation else 2 * math.pi) + 1e-6
        if transforms == "se2":  # the position of the bump alone does not give the angle
            continue
        turned = np.array(euler_matrix(math.atan2(y, x), 0, 0)) @ euler_matrix(*before[4:])
        found = np.array(euler_matrix(*after[4:]))
        is_swapped = np.abs(found - turned @ SWAP).max() < 0.02
        assert is_swapped or np.abs(found - turned).max() < 0.02
        swapped += is_swapped
    if transforms != "se2":
        assert (15 < swapped < 45) if half_rotation else swapped == 0


def share_of_differences(images, others):
    """Return the share of entries that differ by more than one from all within one pixel."""
    greatest, least = F.max_pool2d(others, 3, 1, 1), -F.max_pool2d(-others, 3, 1, 1)
    return float(((images > greatest + 1) | (images < least - 1)).float().mean())


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (0.35, 0.0), (-0.2, 0.3)])
def test_the_projections_equal_those_of_a_pick_in_the_transformed_scene(tilts):
    """Exactly where the fingers stay, and within a voxel where they are swapped."""
    heights = np.zeros((SIZE, SIZE))
    heights[28:42, 29:34], heights[31:34, 33:40], heights[37:40, 26:33] = 0.03, 0.05, 0.07
    heights[20:24, 20:44] = 0.02

    def in_hand(heights, action):
        angles = action[4:].double().tolist()
        view = PickView(heights, heights, (32.0, 32.0), 0.4 / SIZE, float(action[3]), *angles)
        return IN_HAND_MODES["proj"]().draw(view, 24)

    action = torch.tensor([0.0, *CENTER, 0.04, 0.3, *tilts])
    before = in_hand(heights, action)
    data = transitions(heights, action.expand(40, 7), before)
    out = augmentation("cn", order=4)(data)
    seen = set()
    for pixels, image, following, moved in zip(
        out["heightmap"], out["in_hand"], out["next", "in_hand"], out["action"], strict=True
    ):
        (turn,) = (
            k for k in range(4) if np.array_equal(np.rot90(data["heightmap"][0, 0], k), pixels[0])
        )
        wanted = torch.from_numpy(in_hand(np.rot90(heights, turn), moved)).float()
        assert torch.equal(image, following)
        if turn < 2:
            assert torch.equal(image, wanted)
        else:  # wrapped: the gripper is turned over
            assert share_of_differences(image, wanted) < 0.02
            assert share_of_differences(torch.from_numpy(before).float(), wanted) > 0.1
            assert moved[5:].tolist() == pytest.approx([-tilt for tilt in tilts])
        seen.add(turn)
    assert seen == {0, 1, 2, 3}


@pytest.mark.parametrize(("transforms", "order"), [("cn", 16), ("cn", 7), ("se2", 1)])
def test_images_are_reversed_where_the_grid_swaps_the_fingers(transforms, order):
    """On the grid, as in the scene: the pose of the tool and the image in its axes agree."""
    levels = (Level(("x", "y"), (SIZE, SIZE)), Level(("rz",), (8,)))
    levels += (Level(("z",), (9,)), Level(("ry",), (7,)), Level(("rx",), (7,)))
    limits = {"ry": (-0.6, 0.6), "rx": (-0.6, 0.6)}
    grid = SpatialActions(OpenLoopActions("pxyzrrr", BOUNDS), levels, limits)
    rng = np.random.default_rng(1)
    poses = rng.uniform((0.0, -0.4, -0.4), (math.pi, 0.4, 0.4), (600, 3))
    action = np.concatenate([np.zeros((600, 1)), np.tile([[0.47, 0.0, 0.07]], (600, 1)), poses], 1)
    action = grid.nearest(torch.from_numpy(action).float())
    in_hand = np.arange(3 * 24 * 24, dtype=np.float64).reshape(3, 24, 24)
    data = transitions(spot(), action, in_hand)
    module = augmentation(transforms, order=order, grid=grid)
    angles = []
    draw = module._draw_inside

    def recorded(moved):
        is_found, transform = draw(moved)
        angles.append(torch.where(is_found, transform.angle_rad, 0.0))
        return is_found, transform

    module._draw_inside = recorded
    out = module(data)
    after = out["action"]
    assert torch.equal(grid.nearest(after), after)
    kept = (out["in_hand"] == data["in_hand"]).flatten(1).all(1)
    assert 0.3 < kept.float().mean() < 0.7
    for i in range(600):
        turned = np.array(euler_matrix(float(angles[0][i]), 0, 0)) @ euler_matrix(
            *action[i, 4:].double().tolist()
        )
        wanted = turned if kept[i] else turned @ SWAP
        found = np.array(euler_matrix(*after[i, 4:].double().tolist()))
        assert np.abs(found - wanted).max() < 0.22, i  # half a step of the yaw is 0.196
