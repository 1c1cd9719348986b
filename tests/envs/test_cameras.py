"""Geometry of cameras: points of the world from the pixels of observed images."""

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.vision.camera_views import VIEWS

SETTINGS = {"seed": 1}  # the block is not below the gripper
PICKING = "close_loop/block_picking"
TURNED = torch.tensor([1.0, 0.4, 0.3, 0.2, 0.5])
"""An action after which cameras of the gripper are neither above the centre nor along x."""


def pixel_of(camera, point):
    """Row and column of a point, by the camera's matrices."""
    *xy, z = np.linalg.solve(camera.pose, [*point, 1.0])[:3]
    scale = z if camera.projection == "perspective" else 1.0
    u, v, _ = camera.intrinsics @ [*np.divide(xy, scale), 1.0]
    return round(v), round(u)


def top_of(env):
    body = env.scene.task.objects[0]
    return np.add(body.position, (0.0, 0.0, body.shape.size_m[2] / 2))


@pytest.fixture(scope="module")
def turned():
    env = ba_torchrl.make(PICKING, seed=1, random_orientation=False)
    env.step(env.reset().set("action", TURNED))
    yield env
    env.close()


@pytest.mark.parametrize("view", list(VIEWS))
def test_the_pixel_of_a_block_shows_its_top(turned, monkeypatch, view):
    monkeypatch.setattr(turned, "_view", VIEWS[view])
    image = turned._images(turned.scene)["depth"][-1]
    camera, top = turned.camera("depth"), top_of(turned)
    row, column = pixel_of(camera, top)
    pixel_m = 1 / camera.intrinsics[0, 0]
    if camera.projection == "perspective":
        pixel_m *= np.linalg.norm(top - camera.pose[:3, 3])
    assert camera.points(image)[row, column] == pytest.approx(top, abs=pixel_m)
    assert camera.near_m <= image.min() <= image.max() <= camera.far_m


def test_the_pixel_of_a_heightmap_shows_the_top_of_the_block(make):
    env = make("open_loop/block_stacking", obs_size=128)
    td, camera = env.reset(), env.camera("heightmap")
    top = top_of(env)
    row, column = pixel_of(camera, top)
    found = camera.points(td["heightmap"].numpy())[row, column]
    assert found == pytest.approx(top, abs=1 / camera.intrinsics[0, 0])
    assert (camera.near_m, camera.far_m) == (0.0, env.workspace.z[1])


def test_points_of_rgb_depth_are_those_of_the_point_cloud(make):
    env = make(
        PICKING, rgb=True, camera_size=128, point_cloud=20_000, observations=["segmentation"]
    )
    td = env.step(env.reset().set("action", TURNED))["next"]
    points = torch.from_numpy(env.camera("rgb_depth").points(td["rgb_depth"].numpy())).float()
    body, space = td["segmentation"][0], env.workspace
    block, floor = points[body == 2], points[body == 0]
    low, high = torch.tensor([space.x, space.y]).T
    floor = floor[((floor[:, :2] > low) & (floor[:, :2] < high)).all(1)]
    assert len(block) > 20
    assert len(floor) > 1000
    assert floor[:, 2].abs().max() < 0.002
    cloud = td["point_cloud"]
    distance = torch.cdist(torch.cat([block, floor[::10]]), cloud).amin(1)
    assert distance.quantile(0.95) < 0.005  # the points of the cloud are 2 mm apart
    above = cloud[cloud[:, 2] > 0.01]
    on_block = above[(above - block.mean(0)).norm(dim=1) < 0.05]
    assert on_block.amax(0) == pytest.approx(block.amax(0).tolist(), abs=0.006)


def test_colours_and_unseen_images_have_no_points(make):
    env = make(PICKING, observations=["wrist_rgb"])
    td = env.reset()
    wrist = env.camera("wrist_rgb")
    assert wrist.pose[:3, 2] @ (0, 0, -1) > 0.5  # it looks down
    with pytest.raises(ConfigError, match="'rgb_depth'"):
        wrist.points(td["wrist_rgb"][0])
    with pytest.raises(ConfigError, match="no camera observes 'rgb'"):
        env.camera("rgb")
    with pytest.raises(ConfigError, match=r"must be \[128, 128\]"):
        env.camera("depth").points(np.zeros((3, 3)))
