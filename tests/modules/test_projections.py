"""Projections of candidate poses: against loops, the in-hand image and a scene that is rotated."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ba_torchrl.modules.spatial.projections import (
    cell_table,
    project,
    project_upright,
    rotated_cells,
    tool_rotations,
)
from ba_torchrl.modules.spatial.views import patches
from ba_torchrl.sim.geometry import euler_matrix
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView
from ba_torchrl.sim.world import World
from tests.sim.vision.voxel_loop import project_by_loops

PIXEL_M = 0.4 / 128


def heightmaps(size, seed=0):
    """A rough surface, blocks, an empty floor, and a slope."""
    rng = np.random.default_rng(seed)
    rough = rng.uniform(0.0, 0.1, (size, size))
    blocks = np.zeros((size, size))
    blocks[size // 3 : size // 2, 2 : size // 2], blocks[: size // 4, -3:] = 0.03, 0.06
    slope = np.add.outer(np.arange(size), 0.3 * np.arange(size)) * 0.002
    return np.stack([rough, blocks, np.zeros((size, size)), slope])


def poses(count, seed=0):
    """Heights and angles of K poses for each of the heightmaps; the first ones are on the grid."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.0, 0.2, (4, count))
    angles = rng.uniform((0, -0.4, -0.4), (math.pi, 0.4, 0.4), (4, count, 3))
    angles[:, 0] = 0.0
    angles[:, 1] = math.pi / 4, 0.0, 0.0
    angles[:, 2] = 3 * math.pi / 4, 0.0, -math.pi / 12
    angles[:, 3] = math.pi / 2, math.pi / 8, 0.0
    return torch.from_numpy(z), torch.from_numpy(angles)


def encode(heights, z, angles, pixel_m=PIXEL_M):
    cells = rotated_cells(tool_rotations(*angles.flatten(0, 1).unbind(-1)), heights.shape[-1])
    return project(heights, pixel_m, z, cells.unflatten(0, z.shape))


@pytest.mark.parametrize("size", [24, 40])
def test_the_encoding_equals_the_in_hand_image_at_the_same_pose(size):
    heights, (z, angles) = heightmaps(size), poses(9)
    images = encode(torch.from_numpy(heights), z, angles)
    for b, k in np.ndindex(4, 9):
        center = (size / 2, size / 2)
        view = PickView(
            heights[b], heights[b], center, PIXEL_M, float(z[b, k]), *angles[b, k].tolist()
        )
        np.testing.assert_array_equal(images[b, k], IN_HAND_MODES["proj"]().draw(view, size))
    assert (images.flatten(2).std(dim=-1) > 0).any(dim=1)[[0, 1, 3]].all()


def test_a_patch_of_the_heightmap_gives_the_in_hand_image_of_a_pick_at_that_pixel():
    heightmap = np.kron(np.random.default_rng(0).uniform(0.0, 0.1, (16, 16)), np.ones((4, 4)))
    pixels, z, angles = (
        torch.tensor([[20, 41], [3, 60]]),
        torch.tensor([[0.04], [0.08]]),
        (0.6, 0.2, 0.1),
    )
    patch = patches(torch.from_numpy(heightmap)[None, None].repeat(2, 1, 1, 1).float(), pixels, 24)
    images = encode(patch[:, 0], z, torch.tensor(angles).expand(2, 1, 3).double())
    for image, pixel, height in zip(images, pixels.tolist(), z, strict=True):
        center = (pixel[0] + 0.5, pixel[1] + 0.5)
        view = PickView(heightmap, heightmap, center, PIXEL_M, float(height), *angles)
        expected = IN_HAND_MODES["proj"]().draw(view, 24)
        assert (image[0].numpy() != expected).mean() < 0.01  # heights are float32


@pytest.mark.parametrize("size", [11, 24, 40])
def test_upright_projections_equal_those_of_zero_tilts(size):
    heights = torch.from_numpy(heightmaps(size))
    z = torch.linspace(-0.05, 0.2, 36, dtype=torch.float64).expand(4, -1)
    for yaws in ([0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4], [0.3, 1.2, 2.0, 5.0]):
        rz = torch.tensor(yaws, dtype=torch.float64)
        angles = torch.stack([rz, torch.zeros(4), torch.zeros(4)], dim=-1)[:, None].expand(
            -1, 36, 3
        )
        expected = encode(heights, z, angles)
        assert torch.equal(project_upright(heights, PIXEL_M, z, rz), expected)
        for one in range(4):  # every sample alone, with its own yaw
            part = slice(one, one + 1)
            alone = project_upright(heights[part], PIXEL_M, z[part], rz[part])
            assert torch.equal(alone, expected[part])


def test_rotations_are_those_of_the_tool():
    angles = torch.from_numpy(np.random.default_rng(0).uniform(-3, 3, (3, 20)))
    expected = [euler_matrix(*column) for column in angles.T.tolist()]
    torch.testing.assert_close(tool_rotations(*angles), torch.tensor(expected).double())


def test_the_table_holds_the_cells_of_every_combination_of_angles():
    axes = ((0.0, 0.8, 1.6), (-0.3, 0.3), (-0.2, 0.0, 0.1, 0.2))
    table = cell_table(*axes, 6, torch.device("cpu"))
    assert table.shape == (3, 2, 4, 6, 6, 6)
    for i, j, k in np.ndindex(3, 2, 4):
        angles = torch.tensor([[axes[0][i], axes[1][j], axes[2][k]]])
        assert torch.equal(table[i, j, k], rotated_cells(tool_rotations(*angles.T), 6)[0])
    assert cell_table(*axes, 6, torch.device("cpu")) is table


# -- the centre of rotation --------------------------------------------------------------------


def symmetric_heights(size):
    """A rough surface that quarter turns about the centre of the patch do not change."""
    rough = np.random.default_rng(0).uniform(0.03, 0.065, (size, size))
    return np.max([np.rot90(rough, k) for k in range(4)], axis=0)


QUARTERS = [k * math.pi / 2 for k in range(4)]


@pytest.mark.parametrize("size", [8, 11, 24, 40])
def test_tools_at_quarter_turns_see_the_same_of_a_scene_with_that_symmetry(size):
    z = torch.full((1, 4), 0.055, dtype=torch.float64)
    for yaw, ry, rx in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (1.1, -0.2, 0.3)):
        angles = torch.tensor([[(yaw + quarter, ry, rx) for quarter in QUARTERS]]).double()
        images = encode(torch.from_numpy(symmetric_heights(size))[None], z, angles)[0]
        assert all(torch.equal(image, images[0]) for image in images)
        assert images[0].std() > 0.3


@pytest.mark.parametrize(("middle", "lowest", "is_equal"), [(3.5, 0, True), (4.0, 1, False)])
def test_a_rotation_about_half_the_size_does_not_keep_that_symmetry(middle, lowest, is_equal):
    """A cube of 8 voxels has its centre at 3.5; the reference implementation rotates about 4 and
    leaves cell 0 empty."""
    heights = symmetric_heights(8).round(5)
    images = [
        project_by_loops(heights, PIXEL_M, 0.055, quarter, 0.0, 0.0, middle, lowest)
        for quarter in QUARTERS
    ]
    assert all((image == images[0]).all() for image in images) is is_equal


# -- a scene that is rotated in the simulator -------------------------------------------------

PIXEL = (52, 71)
BOXES = [
    # size, position relative to the pixel, yaw
    ((0.03, 0.03, 0.03), (0.004, -0.006), 0.3),
    ((0.12, 0.03, 0.02), (-0.02, 0.03), 1.1),
    ((0.02, 0.05, 0.06), (0.02, 0.014), -0.4),
]


def scene(turn_rad):
    """Return the heightmap of the boxes, rotated about the centre of the pixel."""
    center = [-0.2 + (index + 0.5) * PIXEL_M for index in PIXEL]
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    with World() as world:
        bodies = [world.add(Box(size_m=size), f"{size}") for size, _, _ in BOXES]
        for body, (size, (x, y), yaw) in zip(bodies, BOXES, strict=True):
            position = (center[0] + cos * x - sin * y, center[1] + sin * x + cos * y, size[2] / 2)
            body.place(position, yaw + turn_rad)
        heights = HeightCamera(bodies).heightmap((0.0, 0.0), 0.4, 128)
    return torch.from_numpy(heights)[None, None]


def seen(heights, size, yaw_rad):
    """Return the encodings of several heights and tilts at one yaw."""
    z = torch.tensor([[0.02, 0.04, 0.03, 0.03, 0.05]], dtype=torch.float64)
    tilts = torch.tensor(
        [[0, 0], [0, 0], [math.pi / 8, 0], [0, -math.pi / 12], [-math.pi / 24, math.pi / 8]],
        dtype=torch.float64,
    )
    angles = torch.cat([torch.full((5, 1), yaw_rad, dtype=torch.float64), tilts], dim=1)[None]
    patch = patches(heights, torch.tensor([PIXEL]), size)[:, 0]
    return encode(patch, z, angles)[0]


@pytest.mark.parametrize("size", [24, 40])
@pytest.mark.parametrize("quarters", [1, 2])
@pytest.mark.parametrize("yaw", [0.0, 5 * math.pi / 16])
def test_rotating_the_scene_by_quarter_turns_equals_rotating_the_tool(size, quarters, yaw):
    turn = quarters * math.pi / 2
    straight, turned = seen(scene(0.0), size, yaw + turn), seen(scene(-turn), size, yaw)
    assert torch.equal(straight, turned)
    assert not torch.equal(straight, seen(scene(0.0), size, yaw))


def share_of_differences(images, others):
    """Return the share of entries that differ by more than one from all entries of the others
    within one pixel, in the circle that both patches show."""
    size = images.shape[-1]
    offset = torch.arange(size) - (size - 1) / 2
    is_shown = (offset[:, None] ** 2 + offset**2).sqrt() < size / 2 - 2
    greatest, least = F.max_pool2d(others, 3, 1, 1), -F.max_pool2d(-others, 3, 1, 1)
    differs = (images > greatest + 1) | (images < least - 1)
    return differs[..., is_shown].float().mean(dim=(0, 2))


@pytest.mark.slow
@pytest.mark.parametrize("turn", [math.pi / 4, 1.0, 2.5])
@pytest.mark.parametrize("size", [24, 40])
def test_rotating_the_scene_equals_rotating_the_tool_within_a_voxel(size, turn):
    """At least 94 percent of the entries agree within one voxel in position and number."""
    straight, turned = seen(scene(0.0), size, turn), seen(scene(-turn), size, 0.0)
    assert (share_of_differences(straight, turned) < 0.06).all()
    assert (share_of_differences(turned, straight) < 0.06).all()
    # and few do for the tool that is not rotated
    assert (share_of_differences(seen(scene(0.0), size, 0.0), turned) > 0.2).all()
