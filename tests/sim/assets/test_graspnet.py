"""A folder of meshes: which files are read, which are refused, and their scale."""

import errno
import math
import os
from pathlib import Path

import numpy as np
import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets import hulls
from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.assets.graspnet import graspable_scale
from ba_torchrl.sim.meshes import Mesh, box_mesh, merge_meshes, transform_mesh, write_obj


def write_objects(root, **meshes):
    for name, mesh in meshes.items():
        (root / name).mkdir(parents=True)
        write_obj(root / name / "textured.obj", [mesh])
    return str(root)


def angle_iron(size=0.08):
    """Return an L of two slabs, which fills half of its convex hull."""
    return merge_meshes(
        [
            transform_mesh(box_mesh((size, 0.03, 0.02)), (size / 2, 0, 0.01)),
            transform_mesh(box_mesh((0.02, 0.03, size)), (0.01, 0, size / 2)),
        ]
    )


def test_graspnet_takes_one_object_from_each_folder(tmp_path):
    root = write_objects(tmp_path / "models", b=box_mesh((0.05, 0.05, 0.1)), a=angle_iron())
    (tmp_path / "models" / ".hidden").mkdir()
    (tmp_path / "models" / "readme.txt").write_text("not an object")
    shapes = load_object_set("graspnet", root)
    assert list(shapes.names) == ["a", "b"]
    assert len(shapes[1].parts) == 1
    np.testing.assert_allclose(np.ptp(shapes[1].mesh().vertices, axis=0), (0.05, 0.05, 0.1))
    assert len(shapes[0].parts) > 1  # the inner corner of the L stays empty
    volume = sum(hulls.volume_and_center(part)[0] for part in shapes[0].parts)
    assert volume == pytest.approx(0.02 * 0.03 * (0.08 + 0.06), rel=0.2)


def test_a_folder_is_needed_and_must_hold_meshes(tmp_path):
    with pytest.raises(ConfigError, match=r"asset_root.*sub-folder"):
        load_object_set("graspnet")
    with pytest.raises(ConfigError, match=r"no folder .*nowhere.*\.obj"):
        load_object_set("graspnet", str(tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"empty' has no sub-folders.*\.obj"):
        load_object_set("graspnet", str(tmp_path / "empty"))
    (tmp_path / "bare" / "000").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"000' has no mesh file.*\.obj"):
        load_object_set("graspnet", str(tmp_path / "bare"))


@pytest.mark.parametrize(
    "content",
    [
        "",
        "this is no mesh",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "v 1 2 3\n" + 4 * "f 1 1 1\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 9\n",
        "v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
    ],
    ids=["empty", "no mesh", "one triangle", "one point", "unknown vertex", "not a number", "flat"],
)
def test_a_broken_mesh_is_named(tmp_path, content):
    (tmp_path / "models" / "007").mkdir(parents=True)
    (tmp_path / "models" / "007" / "textured.obj").write_text(content)
    shapes = load_object_set("graspnet", str(tmp_path / "models"))
    with pytest.raises(ConfigError, match="007"):
        shapes[0]


def test_an_empty_path_is_not_the_current_folder(tmp_path, monkeypatch):
    write_objects(tmp_path, a=box_mesh((0.05, 0.05, 0.05)))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"needs asset_root, a folder.*\.obj"):
        load_object_set("graspnet", "")
    assert "a" in load_object_set("graspnet", ".").names


def test_suffixes_and_names_ignore_case(tmp_path):
    for folder, name, size in (
        ("a", "M.OBJ", 0.03),
        ("b", "A.obj", 0.04),
        ("b", "NonTextured.Obj", 0.05),
    ):
        (tmp_path / "models" / folder).mkdir(parents=True, exist_ok=True)
        write_obj(tmp_path / "models" / folder / name, [box_mesh((size, size, size))])
    shapes = load_object_set("graspnet", str(tmp_path / "models"))
    extents = [np.ptp(shape.mesh().vertices, axis=0) for shape in shapes]
    np.testing.assert_allclose(extents, [[0.03] * 3, [0.05] * 3])


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda path: path.symlink_to(path.parent / "gone.obj"), "a link to nothing"),
        (lambda path: path.symlink_to(path), "a link to nothing"),
        (Path.mkdir, "a folder"),
        (os.mkfifo, "no file"),  # reading it would block
    ],
    ids=["dangling link", "link to itself", "folder", "pipe"],
)
def test_a_path_with_the_suffix_of_a_mesh_must_be_a_file(tmp_path, make, what):
    write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    (tmp_path / "models" / "007").mkdir()
    make(tmp_path / "models" / "007" / "x.obj")
    with pytest.raises(ConfigError, match=rf"007/x\.obj' is {what}: .*remove the folder '007'"):
        load_object_set("graspnet", str(tmp_path / "models"))


def deny(monkeypatch, method, name):
    """Make a method of `Path` raise PermissionError for paths of this name."""
    allowed = getattr(Path, method)

    def refuse(self):
        if self.name == name:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))
        return allowed(self)

    monkeypatch.setattr(Path, method, refuse)


@pytest.mark.parametrize(
    ("method", "name"),
    [
        ("is_dir", "models"),
        ("iterdir", "models"),
        ("is_dir", "007"),
        ("iterdir", "007"),
        ("is_file", "textured.obj"),
        ("read_bytes", "textured.obj"),
    ],
)
def test_an_unreadable_path_is_named(tmp_path, monkeypatch, method, name):
    root = write_objects(tmp_path / "models", **{"007": box_mesh((0.05, 0.05, 0.05))})
    deny(monkeypatch, method, name)
    with pytest.raises(ConfigError, match=rf"{tmp_path}.*Permission denied.*make it readable"):
        load_object_set("graspnet", root)[0]


def test_a_removed_file_is_named(tmp_path):
    shapes = load_object_set(
        "graspnet", write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    )
    (tmp_path / "models" / "a" / "textured.obj").unlink()
    with pytest.raises(ConfigError, match=r"a/textured\.obj' \(No such file.*restore it"):
        shapes[0]


def rotated(mesh):
    """Return a mesh rotated so that its bounding box is much larger than the mesh."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 2.0], [2.0, 1.0, -2.0], [2.0, -1.5, 1.0]]))[0]
    return Mesh(mesh.vertices @ turn.T, mesh.faces)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (box_mesh((0.3, 0.3, 1e-7)), "measures 1e-07 x 0.3 x 0.3 m: it is flat"),
        (rotated(box_mesh((0.2, 0.1, 1e-7))), "measures 1e-07 x 0.1 x 0.2 m: it is flat"),
        # 0.85 ** 7 = 0.3206: seven steps reduce 12.5 litres to at most 0.6
        (box_mesh((0.05, 5.0, 0.05)), r"0\.05 x 0\.05 x 5 m.* 0\.016 x 0\.016 x 1\.6 m: the tray"),
        # 1 / 0.95 ** 7 = 1.432: seven steps enlarge 1 cm to at least 1.4
        (box_mesh((0.01, 0.01, 0.25)), r"0\.01 x 0\.01 x 0\.25 m.* 0\.014 x 0\.014 x 0\.36 m"),
        (box_mesh((1e-9, 1e-9, 1e-9)), "measures 1e-09 x 1e-09 x 1e-09 m: .* check its unit"),
        (box_mesh((1e200, 1e200, 1e200)), r"measures 1e\+200 x .* check its unit"),
        (box_mesh((0.0, 0.0, 0.0)), "measures 0 x 0 x 0 m"),
    ],
    ids=["sheet", "rotated sheet", "bar", "bar after enlargement", "tiny", "huge", "point"],
)
def test_meshes_of_unsuitable_size_are_refused(tmp_path, own_cache, mesh, message):
    shapes = load_object_set("graspnet", write_objects(tmp_path / "models", **{"007": mesh}))
    with pytest.raises(ConfigError, match=rf"007/textured\.obj' .*{message}"):
        shapes[0]
    assert not own_cache.exists()  # a cached entry would be read without the check


def stepwise_scale(extents):
    """Return the scale, with the documented rules applied step by step."""
    e = np.array(extents, dtype=float)
    while sorted(e)[1] > 0.15:
        e *= 0.8
    while np.prod(e) > 0.0006:
        e *= 0.85
    while e.min() < 0.014:
        e /= 0.95
    return float(e[0] / extents[0])


@pytest.mark.parametrize("size", [(0.02, 0.02, 0.34), (0.15, 0.25, 0.015), (50.0, 40.0, 30.0)])
def test_meshes_at_the_size_limits_are_accepted(tmp_path, size):
    shapes = load_object_set("graspnet", write_objects(tmp_path / "models", a=box_mesh(size)))
    extents = np.ptp(shapes[0].mesh().vertices, axis=0)
    np.testing.assert_allclose(extents, np.array(size) * stepwise_scale(size), rtol=1e-6)


def test_scales_follow_the_rules():
    rng = np.random.default_rng(0)
    for extents in rng.uniform(0.002, 0.5, (300, 3)):
        assert graspable_scale(extents) == pytest.approx(stepwise_scale(extents))
    assert graspable_scale((0.05, 0.05, 0.1)) == 1.0
    assert math.isfinite(graspable_scale((1e-9, 1.0, 1e6)))
