"""Meshes of users: dialects of their files, any size and position, and surfaces with holes."""

import json
import logging
import multiprocessing
import struct
import subprocess
import sys

import numpy as np
import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets import graspnet, hulls
from ba_torchrl.sim.assets.base import load_object_set
from ba_torchrl.sim.meshes import Mesh, box_mesh, merge_meshes
from tests.specs import slow_except

CORNERS = [(0, 0), (60, 0), (60, 30), (30, 30), (30, 60), (0, 60)]  # mm, of an L
VERTICES = [(x / 1000, y / 1000, z) for z in (0.0, 0.04) for x, y in CORNERS]
POLYGONS = [
    [6, 5, 4, 3, 2, 1],
    [7, 8, 9, 10, 11, 12],
    *([i, i % 6 + 1, i % 6 + 7, i + 6] for i in range(1, 7)),
]
"""The faces of the L, two of which are not convex."""
VOLUME_M3 = 1.08e-4


def ell():
    corners = [(p[0], b, c) for p in POLYGONS[2:] for b, c in ((p[1], p[2]), (p[2], p[3]))]
    corners += [(1, c, b) for b, c in ((2, 3), (3, 4), (4, 5), (5, 6))]
    corners += [(7, b, c) for b, c in ((8, 9), (9, 10), (10, 11), (11, 12))]
    return Mesh(np.array(VERTICES), np.array(corners) - 1)


def ell_obj(vertex="v {} {} {}", corner="{}", head="", break_before=""):
    lines = [vertex.format(*v) for v in VERTICES]
    faces = ["f " + " ".join(corner.format(i) for i in p) for p in POLYGONS]
    faces = [face.replace(" ", break_before + " ", 3) for face in faces]
    return head + "\n".join([*lines, *faces]) + "\n"


def blocks_obj():
    """Return each face after its own vertices, to which it refers by negative indices."""
    blocks = []
    for p in POLYGONS:
        blocks += ["v {} {} {}".format(*VERTICES[i - 1]) for i in p]
        blocks.append("f " + " ".join(str(i - len(p)) for i in range(len(p))))
    return "\n".join(blocks) + "\n"


def mixed_tabs(text):
    return "\n".join(
        line.replace(" ", "\t") if i % 2 else line for i, line in enumerate(text.splitlines())
    )


DIALECTS = {
    "plain": ell_obj(),
    "a comment that ends in a backslash": ell_obj(head="# from C:\\models\\\n"),
    "negative indices in blocks": blocks_obj(),
    "tabs": ell_obj().replace(" ", "\t"),
    "tabs in some lines": mixed_tabs(ell_obj()),
    "blanks around": "  " + ell_obj().replace("\n", "  \n  ").replace(" ", "   "),
    "byte-order mark": "\ufeff" + ell_obj(),
    "DOS line ends": ell_obj().replace("\n", "\r\n"),
    "old Macintosh line ends": ell_obj().replace("\n", "\r"),
    "continued lines": ell_obj(break_before=" \\\n"),
    "continued lines with DOS ends": ell_obj(break_before=" \\\r\n"),
    "weights": ell_obj(vertex="v {} {} {} 1.0"),
    "colours": ell_obj(vertex="v {} {} {} 0.5 0.25 1"),
    "texture": ell_obj(corner="{0}/{0}", head="vt 0 0\n" * 12),
    "normals": ell_obj(corner="{0}//{0}", head="vn 0 0 1\n" * 12),
    "texture and normals": ell_obj(corner="{0}/{0}/{0}", head="vt 0 0\nvn 0 0 1\n" * 12),
    "names": "mtllib x.mtl\n" + ell_obj().replace("\nf ", "\ng a\nusemtl b\no c\ns 1\nf "),
    "comments": "# v 9 9 9\n" + ell_obj().replace("\n", " # v 9 9 9\n"),
    "exponents": ell_obj(vertex="v {:e} {:E} {:+.4f}"),
    "capitals": ell_obj().replace("v ", "V ").replace("f ", "F "),
    "no last line end": ell_obj().rstrip(),
}


def write(root, name, content):
    (root / "007").mkdir(parents=True, exist_ok=True)
    path = root / "007" / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("content", DIALECTS.values(), ids=DIALECTS)
def test_dialects_of_obj_give_the_same_solid(tmp_path, content):
    mesh = graspnet.read_mesh(write(tmp_path, "a.obj", content))
    assert hulls.volume_and_center(mesh)[0] == pytest.approx(VOLUME_M3)
    # concave faces are not covered by triangles outside of them
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(2 * 0.0027 + 0.24 * 0.04)


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("v 1 2", "'v 1 2'"),
        ("v 0,5 0 0", "'v 0,5 0 0'"),
        ("f 1 2", "three corners"),
        ("f 0 1 2", "no such vertex"),
        ("f -1 -2 -13", "no such vertex"),
        ("f 1 2 13", "vertex 13 of 12"),
        ("f 1 2 x", "'f 1 2 x'"),
    ],
)
def test_a_statement_that_cannot_be_read_is_named(tmp_path, statement, message):
    path = write(tmp_path, "a.obj", ell_obj() + statement + "\n")
    with pytest.raises(ConfigError, match=rf"007/a\.obj.*{message}"):
        graspnet.read_mesh(path)


def test_text_in_two_bytes_per_character_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"007/a\.obj"):
        graspnet.read_mesh(write(tmp_path, "a.obj", ell_obj().encode("utf-16")))


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb", "STL"])
def test_other_formats_give_the_same_solid_and_truncated_ones_are_refused(tmp_path, suffix):
    import trimesh

    content = trimesh.Trimesh(*ell(), process=False).export(file_type=suffix.lower())
    path = write(tmp_path, f"a.{suffix}", content)
    assert load_object_set("graspnet", str(tmp_path)).paths == [path]
    mesh = graspnet.read_mesh(path)
    assert hulls.volume_and_center(mesh)[0] == pytest.approx(VOLUME_M3, rel=1e-5)
    path.write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(ConfigError, match="007"):
        graspnet.read_mesh(path)


def test_instances_of_a_mesh_are_placed(tmp_path):
    import trimesh

    scene, mirror = trimesh.Scene(), np.diag([-1.0, 1, 1, 1])
    for i, pose in enumerate((np.eye(4), mirror)):
        scene.add_geometry(trimesh.Trimesh(*ell(), process=False), str(i), transform=pose)
    mesh = graspnet.read_mesh(write(tmp_path, "a.glb", scene.export(file_type="glb")))
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.12, 0.06, 0.04])
    assert hulls.volume_and_center(mesh)[0] == pytest.approx(2 * VOLUME_M3, rel=1e-5)


def glb(points, **changed):
    """A GLB file of one triangle for each three points, with some entries of its header changed."""
    data = np.asarray(points, "<f4").tobytes()
    place = {"buffer": 0, "byteLength": len(data)}
    value = {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"}
    mesh = {"primitives": [{"attributes": {"POSITION": 0}}]}
    header = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "meshes": [mesh]}
    header |= {"nodes": [{"mesh": 0}], "accessors": [value], "bufferViews": [place]}
    header |= {"buffers": [{"byteLength": len(data)}], **changed}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


HUGE = {"componentType": 5126, "count": 10**12, "type": "VEC3"}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"accessors": [HUGE]}, "333333333333 triangles, the most are 100"),
        ({"nodes": [{"mesh": 0}] * 30, "scenes": [{"nodes": [*range(30)]}]}, "120 triangles"),
        ({"buffers": [{"byteLength": 36, "uri": "../b.bin"}]}, "'../b.bin'; export it as one file"),
    ],
)
def test_a_file_that_announces_more_than_it_has_is_refused(tmp_path, monkeypatch, changed, message):
    monkeypatch.setattr(graspnet, "MAX_TRIANGLES", 100)
    points = ball().vertices[[0, 1, 2, 0, 2, 3, 0, 3, 1, 1, 3, 2]]
    assert len(graspnet.read_mesh(write(tmp_path, "a.glb", glb(points))).faces) == 4
    with pytest.raises(ConfigError, match=rf"007/a\.glb.*{message}"):
        graspnet.read_mesh(write(tmp_path, "a.glb", glb(points, **changed)))


def test_obj_is_preferred_and_hidden_files_are_skipped(tmp_path):
    path = write(tmp_path, "textured.obj", ell_obj())
    for name in ("._textured.obj", ".textured.obj", "nontextured.ply", "a.stl"):
        (path.parent / name).write_text("no mesh")
    assert load_object_set("graspnet", str(tmp_path)).paths == [path]
    path.unlink()
    (path.parent / "nontextured.ply").unlink()
    (path.parent / "a.stl").unlink()
    with pytest.raises(ConfigError, match="007' has no mesh file"):
        load_object_set("graspnet", str(tmp_path))


def load(root, mesh):
    """Return the shape of a mesh that is written with all its digits."""
    lines = ["v {!r} {!r} {!r}".format(*vertex) for vertex in mesh.vertices.tolist()]
    lines += ["f {} {} {}".format(*face) for face in (mesh.faces + 1).tolist()]
    write(root / "models", "a.obj", "\n".join(lines))
    return load_object_set("graspnet", str(root / "models"))[0]


def volume(shape):
    return sum(hulls.volume_and_center(part)[0] for part in shape.parts)


@pytest.mark.parametrize(
    ("scale", "offset_m"),
    slow_except(
        [(1.0, 3e5), (1.0, 5e6), (3e-4, 0.0), (1e5, 0.0), (1.0, 1e9)], [(1.0, 5e6), (1e5, 0.0)]
    ),
)
def test_size_and_position_of_a_mesh_do_not_change_its_shape(tmp_path, scale, offset_m):
    plain = ell()
    mesh = Mesh(plain.vertices * scale + offset_m, plain.faces)
    # in a process of its own: an offset of 5e6 m ends one that decomposes as it is
    with multiprocessing.get_context("fork").Pool(1) as pool:  # daemonic, as workers are
        shape = pool.apply_async(load, (tmp_path, mesh)).get(timeout=240)
        pool.close()
        pool.join()
    extents = np.ptp(shape.mesh().vertices, axis=0)
    np.testing.assert_allclose(extents / extents[0], (1.0, 1.0, 2 / 3), rtol=0.02)
    fill = volume(shape) / extents.prod()
    assert fill == pytest.approx(VOLUME_M3 / (0.06 * 0.06 * 0.04), rel=0.05)
    assert extents.max() < graspnet.MAX_LENGTH_M


@pytest.mark.parametrize(
    ("program", "limit_s", "reason"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", 60, "SIGSEGV"),
        ("import time; time.sleep(60)", 0.2, "timed out"),
        ("raise MemoryError('no memory')", 60, "MemoryError: no memory"),
    ],
)
def test_a_decomposition_that_dies_is_an_error_that_names_the_file(
    tmp_path, own_cache, monkeypatch, program, limit_s, reason
):
    from ba_torchrl.sim.assets import decomposition

    monkeypatch.setattr(decomposition, "_VHACD_PROGRAM", program)
    monkeypatch.setattr(decomposition, "VHACD_LIMIT_S", limit_s)
    with pytest.raises(ConfigError, match=rf"007/a\.obj'.*{reason}.* 20 triangles"):
        load(tmp_path, ell())
    assert not own_cache.exists()


def test_parts_that_differ_from_the_mesh_are_replaced_by_the_hull(tmp_path, monkeypatch, caplog):
    from ba_torchrl.sim.assets import decomposition

    corners = [
        Mesh(box_mesh((0.1, 0.1, 0.1)).vertices + sign * np.array([0.43, 0.43, 0.27]), faces)
        for sign, faces in ((-1, box_mesh((1, 1, 1)).faces), (1, box_mesh((1, 1, 1)).faces))
    ]
    wrong_parts = {
        "no part": [],
        "different extents": [box_mesh((0.5, 0.5, 0.5))],
        "% of its volume": corners,
    }
    for i, (reason, wrong) in enumerate(wrong_parts.items()):
        monkeypatch.setattr(decomposition, "_vhacd", lambda *_, wrong=wrong: wrong)
        mesh = Mesh(ell().vertices * 2**i, ell().faces)
        with caplog.at_level(logging.WARNING):
            shape = load(tmp_path / str(i), mesh)
        assert len(shape.parts) == 1
        assert f"{i}/models/007/a.obj' cannot be decomposed" in caplog.text
        assert reason in caplog.text


def test_a_concave_mesh_needs_no_standard_output(tmp_path):
    write(tmp_path, "a.obj", ell_obj())
    program = (
        "import sys; assert sys.stdout is None\n"
        "from ba_torchrl.sim.assets.base import load_object_set\n"
        f"assert len(load_object_set('graspnet', {str(tmp_path)!r})[0].parts) > 1\n"
    )
    command = ["sh", "-c", 'exec "$0" -c "$1" <&- >&-', sys.executable, program]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=240)
    assert done.returncode == 0, done.stderr


def without(mesh, is_lost):
    """Return a mesh without the faces whose centres satisfy a condition."""
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    return Mesh(mesh.vertices, mesh.faces[[not is_lost(center) for center in centers]])


def ball(radius=0.03):
    points = np.random.default_rng(0).normal(size=(150, 3))
    return hulls.convex_hull(radius * points / np.linalg.norm(points, axis=1, keepdims=True))


OPEN = {
    "box without bottom": (without(box_mesh((0.05, 0.06, 0.07)), lambda c: c[2] < -0.03), 2.1e-4),
    "box without ends": (without(box_mesh((0.05, 0.06, 0.07)), lambda c: abs(c[2]) > 0.03), 2.1e-4),
    "L without bottom": (without(ell(), lambda c: c[2] == 0), VOLUME_M3),
    "truncated ball": (without(ball(), lambda c: c[2] > 0), None),
}


@pytest.mark.parametrize("name", slow_except(OPEN, ["L without bottom"]))
def test_an_open_surface_is_closed_and_reported(tmp_path, caplog, name):
    mesh, expected = OPEN[name]
    used = mesh.vertices[np.unique(mesh.faces)]
    expected = expected or hulls.volume_and_center(hulls.convex_hull(used))[0]
    for _ in range(2):  # the second time from the cache
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            shape = load(tmp_path, mesh)
        assert volume(shape) == pytest.approx(expected, rel=0.12)
        (record,) = caplog.records
        assert "007/a.obj' has holes in its surface" in record.getMessage()


def test_sheets_without_an_inside_are_reported(tmp_path, caplog):
    sheet = OPEN["box without bottom"][0]
    both_sides = merge_meshes([sheet, Mesh(sheet.vertices, sheet.faces[:, ::-1])])
    with caplog.at_level(logging.WARNING):
        load(tmp_path, both_sides)
    assert "sheets without an inside" in caplog.text


def mixed_winding(mesh):
    faces = mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    return Mesh(mesh.vertices, faces)


CLOSED = {
    "inverted": Mesh(ell().vertices, ell().faces[:, ::-1]),
    "mixed winding": mixed_winding(ell()),
    "own vertices of each face": Mesh(
        ell().vertices[ell().faces].reshape(-1, 3), np.arange(60).reshape(-1, 3)
    ),
    "twice": merge_meshes([ell(), ell()]),
    "nearly twice": merge_meshes([ell(), Mesh(1.001 * ell().vertices, ell().faces)]),
    "a small hole": without(ell(), lambda c: c[2] == 0 and c[0] > 0.045),
}


@pytest.mark.parametrize("name", slow_except(CLOSED, ["mixed winding", "nearly twice"]))
def test_surfaces_that_enclose_a_solid_are_decomposed_into_it(tmp_path, caplog, name):
    with caplog.at_level(logging.WARNING):
        shape = load(tmp_path, CLOSED[name])
    assert len(shape.parts) > 1
    assert volume(shape) == pytest.approx(VOLUME_M3, rel=0.08)
    assert not caplog.records or name == "a small hole"


def test_crossed_boxes_are_not_taken_for_their_hull(tmp_path, caplog):
    cross = merge_meshes([box_mesh((0.09, 0.03, 0.04)), box_mesh((0.03, 0.09, 0.04))])
    with caplog.at_level(logging.WARNING):
        shape = load(tmp_path, cross)
    assert len(shape.parts) > 1
    assert not caplog.records


def test_walls_that_become_thicker_are_reported(tmp_path, caplog):
    trimesh = pytest.importorskip("trimesh")
    tube = trimesh.creation.annulus(0.03, 0.034, 0.08)
    with caplog.at_level(logging.WARNING):
        shape = load(tmp_path, Mesh(np.asarray(tube.vertices), np.asarray(tube.faces)))
    assert volume(shape) > 1.5 * tube.volume
    assert "walls thinner than" in caplog.text
