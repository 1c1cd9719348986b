"""Meshes as the lists of numbers that PyBullet reads."""

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.meshes import Mesh, gable_mesh, rod_mesh, write_obj
from ba_torchrl.sim.shapes import Solid, mesh_lists

MESHES = {"gable": gable_mesh((0.04, 0.1, 0.03)), "rod": rod_mesh(0.1, 0.02)}


@pytest.mark.parametrize("name", MESHES)
def test_each_face_has_its_corners_and_its_outward_normal(name):
    mesh = MESHES[name]
    lists = mesh_lists(mesh)
    assert np.array_equal(lists.vertices, mesh.vertices)
    assert lists.indices == list(range(3 * len(mesh.faces)))
    for number, face in enumerate(mesh.faces):
        a, b, c = mesh.vertices[face]
        assert np.array_equal(lists.corners[3 * number : 3 * number + 3], [a, b, c])
        for normal in lists.normals[3 * number : 3 * number + 3]:
            assert np.linalg.norm(normal) == pytest.approx(1)
            assert np.dot(normal, b - a) == pytest.approx(0, abs=1e-12)
            assert np.dot(normal, c - a) == pytest.approx(0, abs=1e-12)
            assert np.dot(normal, a) > 0  # these meshes contain their origin


def test_a_face_without_area_has_no_normal():
    line = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert np.array_equal(mesh_lists(line).normals, np.zeros((3, 3)))


def test_equal_meshes_share_their_lists():
    mesh = MESHES["rod"]
    copy = Mesh(np.asfortranarray(mesh.vertices), mesh.faces.astype(np.int32))
    assert mesh_lists(copy) is mesh_lists(mesh)
    assert mesh_lists(Mesh(mesh.vertices * 2, mesh.faces)) is not mesh_lists(mesh)


@pytest.mark.parametrize("name", MESHES)
def test_images_equal_those_of_the_mesh_in_a_file(name, tmp_path):
    color = (0.9, 0.5, 0.2, 1.0)
    file = tmp_path / "mesh.obj"
    write_obj(file, [MESHES[name]])

    def image(create):
        client = pybullet.connect(pybullet.DIRECT)
        try:
            pybullet.createMultiBody(0, -1, create(client), physicsClientId=client)
            view = pybullet.computeViewMatrix((0.1, -0.15, 0.1), (0, 0, 0), (0, 0, 1))
            projection = pybullet.computeProjectionMatrixFOV(50, 1, 0.01, 1)
            _, _, rgb, depth, _ = pybullet.getCameraImage(
                64, 64, view, projection, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client
            )
            return np.array(rgb), np.array(depth)
        finally:
            pybullet.disconnect(client)

    rgb, depth = image(Solid(parts=(MESHES[name],), color=color).create_visual)
    expected_rgb, expected_depth = image(
        lambda client: pybullet.createVisualShape(
            pybullet.GEOM_MESH, fileName=str(file), rgbaColor=color, physicsClientId=client
        )
    )
    assert (depth < 1).sum() > 100
    assert np.array_equal(rgb, expected_rgb)
    assert np.array_equal(depth, expected_depth)
