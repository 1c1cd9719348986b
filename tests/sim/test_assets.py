"""Object sets: what is in them, what a folder of meshes must look like, the cache on disk."""

import errno
import logging
import math
import multiprocessing
import os
from pathlib import Path

import numpy as np
import pybullet
import pytest

from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.assets import cache, graspnet, hulls, random_shapes
from ba_torchrl.sim.assets.base import OBJECT_SETS, load_object_set
from ba_torchrl.sim.assets.cache import CACHE_VARIABLE, cached_parts
from ba_torchrl.sim.assets.graspnet import graspable_scale
from ba_torchrl.sim.assets.household import ITEMS
from ba_torchrl.sim.meshes import Mesh, box_mesh, merge_meshes, transform_mesh, write_obj
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.close_loop_task import CloseLoopTask
from ba_torchrl.tasks.clutter.tray import profile


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_objects(root, **meshes):
    for name, mesh in meshes.items():
        (root / name).mkdir(parents=True)
        write_obj(root / name / "textured.obj", [mesh])
    return str(root)


def angle_iron(size=0.08):
    """An L of two slabs: its hull is half air."""
    return merge_meshes(
        [
            transform_mesh(box_mesh((size, 0.03, 0.02)), (size / 2, 0, 0.01)),
            transform_mesh(box_mesh((0.02, 0.03, size)), (0.01, 0, size / 2)),
        ]
    )


# -- hulls ---------------------------------------------------------------------------------------


def test_hull_of_a_box_with_points_inside_is_the_box():
    points = np.vstack([box_mesh((0.1, 0.2, 0.3)).vertices, [[0.01, 0.02, 0.03]]]) + 1.0
    hull = hulls.convex_hull(points)
    assert len(hull.vertices) == 8
    volume, center = hulls.volume_and_center(hull)
    assert volume == pytest.approx(0.1 * 0.2 * 0.3)  # negative if faces pointed inwards
    np.testing.assert_allclose(center, [1, 1, 1], atol=1e-12)


def test_center_of_a_cone_is_at_a_quarter_of_its_height():
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    base = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
    hull = hulls.convex_hull(np.vstack([base, [[0, 0, 2.0]]]))
    np.testing.assert_allclose(hulls.volume_and_center(hull)[1], [0, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("points", [np.zeros((9, 3)), np.full((9, 3), np.nan), np.eye(3)])
def test_points_without_volume_have_no_hull(points):
    with pytest.raises(ValueError, match="no convex hull"):
        hulls.convex_hull(points)


def test_rests_of_a_box_are_its_six_faces():
    size = (0.03, 0.05, 0.07)
    found = hulls.stable_poses(hulls.convex_hull(box_mesh(size).vertices))
    assert sorted(round(rest.height_m, 6) for rest in found) == sorted(size * 2)
    for rest in found:
        least = min(set(size) - {round(rest.height_m, 6)})
        assert rest.width_m == pytest.approx(least, abs=1e-6)
        assert rest.antipodal_score > 0.9
        # in this pose the fingers' line is along x, the height along z
        extents = np.ptp(box_mesh(size).vertices @ rest.rotation.T, axis=0)
        assert extents[2] == pytest.approx(rest.height_m)
        assert extents[0] <= hulls.MAX_GAP_M + 1e-3
        assert np.linalg.det(rest.rotation) == pytest.approx(1)


def test_a_wedge_is_less_square_than_a_box():
    wedge = np.array([(x, y, z) for x, y in ((0, -0.03), (0, 0.03), (0.04, 0)) for z in (0, 0.03)])
    flat = [rest for rest in hulls.stable_poses(hulls.convex_hull(wedge)) if rest.height_m < 0.031]
    assert flat
    assert all(rest.antipodal_score < 0.8 for rest in flat)


def test_a_body_does_not_rest_on_an_end_it_would_topple_from():
    leaning = box_mesh((0.02, 0.02, 0.1)).vertices.copy()
    leaning[leaning[:, 2] > 0, 0] += 0.06
    heights = [rest.height_m for rest in hulls.stable_poses(hulls.convex_hull(leaning))]
    assert heights
    assert max(heights) < 0.05


def test_samples_lie_on_the_surface_evenly():
    points, normals = hulls.surface_samples(box_mesh((0.1, 0.1, 0.2)), 1000)
    assert np.all(np.abs(points) <= np.array([0.05, 0.05, 0.1]) + 1e-12)
    outer = np.abs(points) > np.array([0.05, 0.05, 0.1]) - 1e-12
    assert np.all(outer.any(axis=1))
    assert np.all(np.einsum("ij,ij->i", points, normals) > 0)
    assert (np.abs(normals[:, 2]) > 0.5).mean() == pytest.approx(0.2, abs=0.02)


# -- the sets that come with the package --------------------------------------------------------


@pytest.mark.parametrize(("name", "least"), [("random", 86), ("household", 12)])
def test_sets_hold_named_shapes_of_one_material(name, least):
    shapes = load_object_set(name)
    assert len(shapes) == len(set(shapes.names)) >= least
    for shape in shapes:
        assert shape.mass_kg == 0.15
        assert shape.friction == 0.6
        volumes, centers = zip(*map(hulls.volume_and_center, shape.parts), strict=True)
        assert min(volumes) > 0
        center = np.average(centers, axis=0, weights=volumes)
        np.testing.assert_allclose(center, 0, atol=1e-9)
        extents = np.sort(np.ptp(shape.mesh().vertices, axis=0))
        assert 0.012 < extents[0] < 0.066  # a gripper takes 8 cm
        assert extents[2] < 0.155


def test_shapes_are_made_when_asked_for(monkeypatch):
    shapes = load_object_set("random")
    asked = []
    parts = type(shapes).parts
    monkeypatch.setattr(type(shapes), "parts", lambda self, i: asked.append(i) or parts(self, i))
    assert shapes[-1] is shapes[85]
    assert [shapes[85]] == shapes[85:]
    assert asked == [85]
    with pytest.raises(IndexError):
        shapes[86]


def test_random_shapes_suit_as_they_say():
    for number, scale in random_shapes.SELECTION[::8]:
        found = random_shapes.scaled_candidate(number)
        assert found is not None
        assert found.scale == scale


def test_unsuitable_random_shapes_are_refused(monkeypatch):
    assert random_shapes.scaled_candidate(168) is None  # its file holds numbers that are none
    number, _ = random_shapes.SELECTION[0]
    for limit, value in (("MAX_LENGTH_M", 0.01), ("MIN_HEIGHT_M", 0.2), ("MIN_FILL", 1.01)):
        with monkeypatch.context() as patch:
            patch.setattr(random_shapes, limit, value)
            assert random_shapes.scaled_candidate(number) is None


@pytest.mark.slow
def test_the_choice_of_random_shapes_follows_from_the_criterion():
    assert random_shapes.select_shapes() == random_shapes.SELECTION


def test_random_shapes_stand_so_that_fingers_at_yaw_zero_fit():
    for shape in load_object_set("random"):
        low, high = shape.bounds_m
        vertices = shape.mesh().vertices
        across = vertices[np.abs(vertices[:, 1]) < hulls.FINGER_HALF_WIDTH_M]
        assert len(across) == 0 or np.ptp(across[:, 0]) <= hulls.MAX_GAP_M + 1e-3
        assert high[2] - low[2] >= random_shapes.MIN_HEIGHT_M - 1e-6


def test_what_is_hollow_takes_something_in():
    shapes = load_object_set("household")
    for name in ("mug", "tumbler", "bowl"):
        shape = shapes[shapes.names.index(name)]
        with World() as world:
            vessel = world.add(shape, name)
            vessel.place((0.0, 0.0, -shape.bounds_m[0][2]))
            pea = world.add(Box(size_m=(0.012, 0.012, 0.012), mass_kg=0.01), "pea")
            pea.place((0.0, 0.0, 0.5 * shape.height_m))
            assert world.settle(400)
            assert 0.009 < pea.position[2] < 0.016  # on the bottom
            assert math.hypot(*pea.position[:2]) < 0.02
            assert vessel.tilt_rad < 0.1


def test_every_item_comes_to_rest_on_the_floor():
    shapes = load_object_set("household")
    with World() as world:
        for i, (name, shape) in enumerate(zip(shapes.names, shapes, strict=True)):
            world.add(shape, name).place((0.3 * i, 0.0, 0.005 - shape.bounds_m[0][2]))
        world.step(240)
        for body in world.bodies:
            (_, _, z), turn = body.pose
            matrix = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))
            lowest = z + (body.shape.mesh().vertices @ matrix.T)[:, 2].min()
            assert abs(lowest) < 1.5e-3, body.name
    assert list(ITEMS) == list(shapes.names)


def test_an_unknown_set_and_a_needless_folder_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="household"):
        load_object_set("houshold")
    for name in set(OBJECT_SETS) - {"graspnet"}:
        for root in (str(tmp_path), ""):
            with pytest.raises(ConfigError, match="asset_root"):
                load_object_set(name, root)


# -- a folder of meshes -------------------------------------------------------------------------


def test_graspnet_takes_one_object_from_each_folder(tmp_path):
    root = write_objects(tmp_path / "models", b=box_mesh((0.05, 0.05, 0.1)), a=angle_iron())
    (tmp_path / "models" / ".hidden").mkdir()
    (tmp_path / "models" / "readme.txt").write_text("not an object")
    shapes = load_object_set("graspnet", root)
    assert list(shapes.names) == ["a", "b"]
    assert len(shapes[1].parts) == 1
    np.testing.assert_allclose(np.ptp(shapes[1].mesh().vertices, axis=0), (0.05, 0.05, 0.1))
    assert len(shapes[0].parts) > 1  # the corner of the L stays open
    volume = sum(hulls.volume_and_center(part)[0] for part in shapes[0].parts)
    assert volume == pytest.approx(0.02 * 0.03 * (0.08 + 0.06), rel=0.2)


def test_of_several_files_the_plain_one_is_taken(tmp_path):
    root = write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    write_obj(tmp_path / "models/a/nontextured.obj", [box_mesh((0.04, 0.04, 0.04))])
    extents = np.ptp(load_object_set("graspnet", root)[0].mesh().vertices, axis=0)
    np.testing.assert_allclose(extents, 0.04)


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
    ids=["empty", "prose", "one triangle", "one point", "no such corner", "not a number", "flat"],
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


def test_suffixes_and_names_are_taken_in_any_case(tmp_path):
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


def dangle(path):
    path.symlink_to(path.parent / "gone.obj")


def loop(path):
    path.symlink_to(path)


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (dangle, "a link to nothing"),
        (loop, "a link to nothing"),
        (Path.mkdir, "a folder"),
        (os.mkfifo, "no file"),  # reading it would wait for ever
    ],
    ids=["dangling link", "link to itself", "folder", "pipe"],
)
def test_what_is_called_like_a_mesh_file_must_be_one(tmp_path, make, what):
    write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    (tmp_path / "models" / "007").mkdir()
    make(tmp_path / "models" / "007" / "x.obj")
    with pytest.raises(ConfigError, match=rf"007/x\.obj' is {what}: .*remove the folder '007'"):
        load_object_set("graspnet", str(tmp_path / "models"))


def test_a_link_to_a_mesh_file_is_followed(tmp_path):
    root = write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    (tmp_path / "models" / "b").mkdir()
    (tmp_path / "models" / "b" / "x.obj").symlink_to("../a/textured.obj")
    np.testing.assert_allclose(np.ptp(load_object_set("graspnet", root)[1].mesh().vertices), 0.05)


def deny(monkeypatch, method, name):
    """Let the file system refuse a path of this name, whoever asks."""
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
def test_what_may_not_be_read_is_named(tmp_path, monkeypatch, method, name):
    root = write_objects(tmp_path / "models", **{"007": box_mesh((0.05, 0.05, 0.05))})
    deny(monkeypatch, method, name)
    with pytest.raises(ConfigError, match=rf"{tmp_path}.*Permission denied.*make it readable"):
        load_object_set("graspnet", root)[0]


def test_a_file_that_goes_away_is_named(tmp_path):
    shapes = load_object_set(
        "graspnet", write_objects(tmp_path / "models", a=box_mesh((0.05, 0.05, 0.05)))
    )
    (tmp_path / "models" / "a" / "textured.obj").unlink()
    with pytest.raises(ConfigError, match=r"a/textured\.obj' \(No such file.*restore it"):
        shapes[0]


def askew(mesh):
    """A mesh, turned so that its bounding box tells little about it."""
    turn = np.linalg.qr(np.array([[1.0, 2.0, 2.0], [2.0, 1.0, -2.0], [2.0, -1.5, 1.0]]))[0]
    return Mesh(mesh.vertices @ turn.T, mesh.faces)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (box_mesh((0.3, 0.3, 1e-7)), "measures 1e-07 x 0.3 x 0.3 m: it is flat"),
        (askew(box_mesh((0.2, 0.1, 1e-7))), "measures 1e-07 x 0.1 x 0.2 m: it is flat"),
        # 0.85 ** 7 = 0.3206: seven times until 12.5 litres are at most 0.6
        (box_mesh((0.05, 5.0, 0.05)), r"0\.05 x 0\.05 x 5 m.* 0\.016 x 0\.016 x 1\.6 m: the tray"),
        # 1 / 0.95 ** 7 = 1.432: seven times until 1 cm is at least 1.4
        (box_mesh((0.01, 0.01, 0.25)), r"0\.01 x 0\.01 x 0\.25 m.* 0\.014 x 0\.014 x 0\.36 m"),
        (box_mesh((1e-9, 1e-9, 1e-9)), "measures 1e-09 x 1e-09 x 1e-09 m: .* check its unit"),
        (box_mesh((1e200, 1e200, 1e200)), r"measures 1e\+200 x .* check its unit"),
        (box_mesh((0.0, 0.0, 0.0)), "measures 0 x 0 x 0 m"),
    ],
    ids=["sheet", "sheet askew", "bar", "bar made thicker", "tiny", "huge", "point"],
)
def test_what_cannot_be_an_object_in_the_tray_is_refused(tmp_path, own_cache, mesh, message):
    shapes = load_object_set("graspnet", write_objects(tmp_path / "models", **{"007": mesh}))
    with pytest.raises(ConfigError, match=rf"007/textured\.obj' .*{message}"):
        shapes[0]
    assert not own_cache.exists()  # or the parts would be taken from there next time


def test_what_is_too_long_is_refused_before_it_is_cut(tmp_path, monkeypatch):
    iron = angle_iron()
    long = Mesh(iron.vertices * (1.0, 200.0, 1.0), iron.faces)
    shapes = load_object_set("graspnet", write_objects(tmp_path / "models", a=long))
    cut = []
    monkeypatch.setattr(graspnet, "convex_parts", lambda *_: cut.append(1))
    with pytest.raises(ConfigError, match="the tray has room"):
        shapes[0]
    assert not cut


@pytest.mark.parametrize("size", [(0.02, 0.02, 0.34), (0.15, 0.25, 0.015), (50.0, 40.0, 30.0)])
def test_what_fits_is_taken(tmp_path, size):
    shapes = load_object_set("graspnet", write_objects(tmp_path / "models", a=box_mesh(size)))
    extents = np.ptp(shapes[0].mesh().vertices, axis=0)
    np.testing.assert_allclose(extents, np.array(size) * stepwise_scale(size), rtol=1e-6)


def test_the_longest_object_lies_across_the_smaller_tray():
    inner = 2 * profile(CloseLoopTask.workspace.width)[0][0]
    assert inner == pytest.approx(0.25)
    assert 0.98 < graspnet.MAX_LENGTH_M / math.hypot(inner, inner) <= 1


def stepwise_scale(extents):
    """The rules as they are stated, step by step."""
    e = np.array(extents, dtype=float)
    while sorted(e)[1] > 0.15:
        e *= 0.8
    while np.prod(e) > 0.0006:
        e *= 0.85
    while e.min() < 0.014:
        e /= 0.95
    return float(e[0] / extents[0])


def test_scales_follow_the_rules():
    rng = np.random.default_rng(0)
    for extents in rng.uniform(0.002, 0.5, (300, 3)):
        assert graspable_scale(extents) == pytest.approx(stepwise_scale(extents))
    assert graspable_scale((0.05, 0.05, 0.1)) == 1.0
    assert math.isfinite(graspable_scale((1e-9, 1.0, 1e6)))


# -- cache --------------------------------------------------------------------------------------


def test_parts_are_worked_out_once(own_cache):
    made = []

    def make():
        made.append(1)
        return [
            box_mesh((1.0, 2.0, 3.0)),
            transform_mesh(box_mesh((1.0, 1.0, 1.0)), (5.0, 0.0, 0.0)),
        ]

    first, second = (cached_parts(b"content", "recipe", make) for _ in range(2))
    assert len(made) == 1
    assert len(second) == 2
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.faces, b.faces)
    cached_parts(b"other content", "recipe", make)
    cached_parts(b"content", "other recipe", make)
    assert len(made) == 3
    assert not list(own_cache.rglob("*.tmp"))


def test_a_damaged_entry_is_made_anew(own_cache, caplog):
    make = lambda: [box_mesh((1.0, 1.0, 1.0))]  # noqa: E731
    cached_parts(b"content", "recipe", make)
    (path,) = own_cache.rglob("*.npz")
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"not an archive"):
        path.write_bytes(damaged)
        with caplog.at_level(logging.WARNING):
            (part,) = cached_parts(b"content", "recipe", make)
        np.testing.assert_array_equal(part.vertices, box_mesh((1.0, 1.0, 1.0)).vertices)
        assert path.read_bytes() == whole
    assert "computed again" in caplog.text


def test_a_cache_that_cannot_be_written_is_reported_and_done_without(monkeypatch, tmp_path, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        (part,) = cached_parts(b"content", "recipe", lambda: [box_mesh((1.0, 1.0, 1.0))])
    assert isinstance(part, Mesh)
    assert CACHE_VARIABLE in caplog.text


def test_without_the_variable_the_cache_is_the_users(monkeypatch):
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setattr(cache, "user_cache_path", lambda name: Path("/users/cache") / name)
    assert cache.cache_folder() == Path("/users/cache/ba_torchrl/parts")


def _write_the_same(seed):
    vertices = np.random.default_rng(seed % 3).random((2000, 3))
    parts = cached_parts(
        bytes([seed % 3]), "recipe", lambda: [Mesh(vertices, np.array([[0, 1, 2]]))]
    )
    return float(np.abs(parts[0].vertices - vertices).max())


def test_processes_that_write_at_once_do_no_harm(own_cache):
    with multiprocessing.get_context("fork").Pool(6) as pool:
        assert set(pool.map(_write_the_same, range(60), chunksize=1)) == {0.0}
    assert len(list(own_cache.rglob("*.npz"))) == 3
    assert not list(own_cache.rglob("*.tmp"))


def test_the_recipe_names_what_the_parts_depend_on():
    for value in (
        graspnet.CONVEX_FILL,
        graspnet.MESH_LENGTHS_M,
        graspnet.MAX_LENGTH_M,
        graspnet.MIN_FLATNESS,
    ):
        assert str(value) in graspnet.RECIPE
    assert all(str(value) in graspnet.RECIPE for value in graspnet.VHACD.values())
