"""The cache of convex parts on disk."""

import logging
import multiprocessing
import pwd

import numpy as np

from ba_torchrl.sim.assets import cache
from ba_torchrl.sim.assets.cache import CACHE_VARIABLE, Decomposition, cached_parts
from ba_torchrl.sim.meshes import Mesh, box_mesh, transform_mesh
from tests.planted import Planted


def make_box():
    return Decomposition((box_mesh((1.0, 1.0, 1.0)),))


def test_parts_are_computed_once(own_cache):
    made = []

    def make():
        made.append(1)
        parts = (
            box_mesh((1.0, 2.0, 3.0)),
            transform_mesh(box_mesh((1.0, 1.0, 1.0)), (5.0, 0.0, 0.0)),
        )
        return Decomposition(parts, "a note")

    first, second = (cached_parts(b"content", "recipe", make) for _ in range(2))
    assert len(made) == 1
    assert len(second.parts) == 2
    assert first.note == second.note == "a note"
    for a, b in zip(first.parts, second.parts, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.faces, b.faces)
    cached_parts(b"other content", "recipe", make)
    cached_parts(b"content", "other recipe", make)
    assert len(made) == 3
    assert not list(own_cache.rglob("*.tmp"))


def test_a_damaged_entry_is_computed_again(own_cache, caplog):
    cached_parts(b"content", "recipe", make_box)
    (path,) = own_cache.rglob("*.npz")
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"not an archive"):
        path.write_bytes(damaged)
        with caplog.at_level(logging.WARNING):
            (part,) = cached_parts(b"content", "recipe", make_box).parts
        np.testing.assert_array_equal(part.vertices, box_mesh((1.0, 1.0, 1.0)).vertices)
        assert path.read_bytes() == whole
    assert "computed again" in caplog.text


def test_objects_in_an_entry_are_not_unpickled(own_cache, tmp_path):
    cached_parts(b"content", "recipe", make_box)
    (path,) = own_cache.rglob("*.npz")
    planted = np.array([Planted(tmp_path / "trace")])
    np.savez(path, vertices=planted, faces=planted, vertex_ends=planted, face_ends=planted)
    (part,) = cached_parts(b"content", "recipe", make_box).parts
    np.testing.assert_array_equal(part.vertices, box_mesh((1.0, 1.0, 1.0)).vertices)
    assert not (tmp_path / "trace").exists()


def test_a_cache_that_cannot_be_written_is_reported_and_not_used(monkeypatch, tmp_path, caplog):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        for content in (b"content", b"other content"):
            (part,) = cached_parts(content, "recipe", make_box).parts
            assert isinstance(part, Mesh)
    assert caplog.text.count(CACHE_VARIABLE) == 1


def test_a_user_without_a_home_has_no_cache(monkeypatch, caplog):
    for name in (CACHE_VARIABLE, "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", lambda uid: {}[uid])  # a user id without a name
    cache._unusable.clear()
    with caplog.at_level(logging.WARNING):
        for content in (b"content", b"other content"):
            (part,) = cached_parts(content, "recipe", make_box).parts
            assert isinstance(part, Mesh)
    assert caplog.text.count(CACHE_VARIABLE) == 1


def _write_shared_entries(seed):
    vertices = np.random.default_rng(seed % 3).random((2000, 3))
    mesh = Mesh(vertices, np.array([[0, 1, 2]]))
    (part,) = cached_parts(bytes([seed % 3]), "recipe", lambda: Decomposition((mesh,))).parts
    return float(np.abs(part.vertices - vertices).max())


def test_concurrent_writes_leave_valid_entries(own_cache):
    with multiprocessing.get_context("fork").Pool(6) as pool:
        found = pool.map_async(_write_shared_entries, range(60), chunksize=1).get(timeout=240)
        pool.close()
        pool.join()  # the end of the context sends a signal, which a new process can miss
    assert set(found) == {0.0}
    assert len(list(own_cache.rglob("*.npz"))) == 3
    assert not list(own_cache.rglob("*.tmp"))
