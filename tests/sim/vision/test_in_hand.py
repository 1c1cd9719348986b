"""In-hand images, compared with independent arithmetic."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView, crop
from tests.sim.vision.voxel_loop import project_by_loops

SIZE = 24
PIXEL_M = 0.4 / 128


def view(before, after=None, *, center=(64.0, 64.0), z_m=0.015, rz=0.0, ry=0.0, rx=0.0):
    after = np.zeros_like(before) if after is None else after
    return PickView(before, after, center, PIXEL_M, z_m, rz, ry, rx)


def draw(mode, *args, size=SIZE, **options):
    return IN_HAND_MODES[mode]().draw(view(*args, **options), size)


@pytest.fixture
def noise():
    return np.random.default_rng(0).uniform(0.0, 0.1, (128, 128))


def interpolated(heights, row, column):
    """Return the bilinear interpolation at a point in pixel indices, zero outside of the image."""
    i, j = math.floor(row), math.floor(column)
    total = 0.0
    for a in (i, i + 1):
        for b in (j, j + 1):
            if 0 <= a < heights.shape[0] and 0 <= b < heights.shape[1]:
                total += (1 - abs(row - a)) * (1 - abs(column - b)) * heights[a, b]
    return total


@pytest.mark.parametrize("center", [(64.0, 64.0), (63.3, 70.8), (2.0, 126.5), (0.0, 0.0)])
@pytest.mark.parametrize("rz", [0.0, 0.4, -1.1, 2.9])
def test_crop_interpolates_bilinearly(noise, center, rz):
    image = crop(noise, center, SIZE, rz)
    np.testing.assert_array_equal(draw("raw", noise, center=center, rz=rz)[0], image)
    middle = (SIZE - 1) / 2
    for k, m in ((0, 0), (0, 23), (23, 0), (11, 12), (5, 17)):
        a, b = k - middle, m - middle
        row = center[0] - 0.5 + math.cos(rz) * a - math.sin(rz) * b
        column = center[1] - 0.5 + math.sin(rz) * a + math.cos(rz) * b
        assert image[k, m] == pytest.approx(interpolated(noise, row, column), abs=1e-9)


def test_crop_is_zero_outside_of_the_heightmap():
    image = crop(np.ones((128, 128)), (0.0, 64.0), SIZE)
    np.testing.assert_array_equal(image[:12], 0.0)
    np.testing.assert_allclose(image[12:], 1.0)
    np.testing.assert_array_equal(crop(np.ones((128, 128)), (-40.0, 200.0), SIZE), 0.0)


def test_sub_subtracts_the_remaining_height():
    """A block of 3 cm is picked from another block; the height of the floor is unchanged."""
    before, after = np.zeros((128, 128)), np.zeros((128, 128))
    before[60:68, 60:68] = 0.06
    after[60:68, 60:68] = 0.03
    before[52:55, 52:76] = after[52:55, 52:76] = 0.02
    image = draw("sub", before, after)[0]
    expected = np.zeros((SIZE, SIZE))
    expected[8:16, 8:16] = 0.03
    expected[0:3] = 0.02  # lower than the remaining height: unchanged
    np.testing.assert_allclose(image, expected, atol=1e-12)


def test_sub_ignores_heights_far_from_the_tool():
    before = np.full((128, 128), 0.0)
    before[60:68, 60:68] = 0.03
    after = np.zeros((128, 128))
    after[:10, :10] = 0.2  # outside of the crop
    np.testing.assert_array_equal(draw("sub", before, after), draw("raw", before))


@pytest.mark.parametrize(
    ("size", "angles"),
    [
        (12, (0.0, 0.0, 0.0)),
        (12, (math.pi / 4, 0.0, 0.0)),
        (12, (3 * math.pi / 4, 0.0, math.pi / 12)),
        (12, (math.pi / 2, -math.pi / 8, 0.0)),
        (13, (0.7, 0.3, -0.4)),
        (14, (2.9, -0.35, 0.2)),
        (24, (1.1, 0.2, 0.3)),
    ],
    ids=str,
)
def test_proj_equals_a_loop_over_voxels(noise, size, angles):
    heights = crop(noise, (64.0, 64.0), size).round(5)
    rz, ry, rx = angles
    image = draw("proj", noise, z_m=0.05, rz=rz, ry=ry, rx=rx, size=size)
    np.testing.assert_array_equal(image, project_by_loops(heights, PIXEL_M, 0.05, *angles))
    assert 0.1 * size**3 < image[0].sum() < 0.9 * size**3


@pytest.mark.parametrize("mode", sorted(IN_HAND_MODES))
def test_shape_and_values_of_every_mode(mode, noise):
    kind = IN_HAND_MODES[mode]()
    image = kind.draw(view(noise, noise, center=(3.0, 125.0), rz=0.5, ry=0.2, rx=-0.2), SIZE)
    assert image.shape == (kind.channels, SIZE, SIZE)
    assert image.dtype == np.float64
    assert (image >= 0).all()
