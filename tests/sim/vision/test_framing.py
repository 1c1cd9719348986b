"""The camera pose that shows given points, compared with PyBullet's own projection."""

import itertools

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.vision.rgb import fit_viewpoint

FOV_DEG = 40.0
BOX = np.array(list(itertools.product((0.25, 0.65), (-0.2, 0.2), (0.0, 0.15))))


def image_coordinates(points, viewpoint, aspect):
    """Return x and y of points in the image, each from -1 to 1, by PyBullet's matrices."""
    projection = pybullet.computeProjectionMatrixFOV(FOV_DEG, aspect, 0.05, 10.0)
    matrix = np.reshape(projection, (4, 4)).T @ np.reshape(viewpoint.view_matrix(), (4, 4)).T
    clip = np.pad(points, ((0, 0), (0, 1)), constant_values=1.0) @ matrix.T
    assert (clip[:, 3] > 0).all()  # in front of the camera
    return clip[:, :2] / clip[:, 3:]


@pytest.mark.parametrize("margin", [0.0, 0.1])
@pytest.mark.parametrize("aspect", [0.5, 4.0])
@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(78, -33), (-20, -60), (200, -5)])
def test_the_points_fill_the_image_up_to_the_margin(yaw_deg, pitch_deg, aspect, margin):
    viewpoint = fit_viewpoint(BOX, yaw_deg, pitch_deg, FOV_DEG, aspect, margin)
    xy = image_coordinates(BOX, viewpoint, aspect) / (1 - 2 * margin)
    assert np.abs(xy).max() <= 1 + 1e-5
    (left, bottom), (right, top) = xy.min(0), xy.max(0)
    assert bottom == pytest.approx(-1, abs=1e-5)
    fills_width = (left, right) == pytest.approx((-1, 1), abs=1e-5)
    fills_height = top == pytest.approx(1, abs=1e-5)
    assert fills_width or fills_height


def test_the_target_is_at_the_centre_of_the_image():
    viewpoint = fit_viewpoint(BOX, 78, -33, FOV_DEG, 1.2)
    target = image_coordinates(np.array([viewpoint.target_m]), viewpoint, 1.2)
    np.testing.assert_allclose(target, 0, atol=1e-5)
