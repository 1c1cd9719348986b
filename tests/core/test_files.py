"""Checksums of folders, atomic text files, and states without pickle."""

import contextlib
import errno
import fcntl
import json
import os
import signal

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from ba_torchrl.core import files
from ba_torchrl.core.errors import ConfigError, DamagedFilesError
from ba_torchrl.core.files import (
    CHECKSUMS_FILE,
    Lock,
    atomic_file,
    atomic_output,
    lock_holder,
    read_json,
    read_state,
    verify_checksums,
    write_checksums,
    write_state,
    write_text,
)
from tests.fresh import run_script

weights = torch.arange(6.0).reshape(2, 3)
STATE = {
    "weights": weights,
    "empty": torch.zeros(0, dtype=torch.uint8),
    "shared": (weights, weights[1], weights.T),
    "generator": ("MT19937", np.arange(3, dtype=np.uint32)),
    "nested": {"step": 3, "largest": (0.25, 7), "rows": [True, None, "text"], 5: {}},
}


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "state"
    write_state(path / "part", STATE)
    write_checksums(path)
    return path


def weights_of(folder):
    return max(folder.rglob("*.safetensors"), key=lambda path: path.stat().st_size)


def test_a_state_is_read_as_it_was_written(folder):
    verify_checksums(folder)
    state = read_state(folder / "part")
    assert torch.equal(state["weights"], STATE["weights"])
    assert state["empty"].shape == (0,)
    assert state["nested"] == STATE["nested"]
    assert all(map(torch.equal, state["shared"], STATE["shared"]))
    name, numbers = state["generator"]
    assert (name, numbers.dtype, numbers.tolist()) == ("MT19937", np.uint32, [0, 1, 2])
    assert {path.suffix for path in folder.rglob("*") if path.is_file()} == {
        ".json",
        ".safetensors",
    }


def test_the_tensors_read_do_not_depend_on_the_files(folder):
    state = read_state(folder / "part")
    weights_of(folder).write_bytes(b"\xff" * 24)
    assert torch.equal(state["weights"], STATE["weights"])


def cut_in_half(folder):
    path = weights_of(folder)
    size = path.stat().st_size
    os.truncate(path, size // 2)
    return f"has {path.stat().st_size} bytes, {size} were written"


def flip_one_bit(folder):
    path = weights_of(folder)
    content = bytearray(path.read_bytes())
    content[5] ^= 1
    path.write_bytes(content)
    return "its checksum differs"


def delete_one(folder):
    weights_of(folder).unlink()
    return "is missing"


def add_one(folder):
    (folder / "more.safetensors").write_bytes(b"abc")
    return "is not listed"


def delete_the_checksums(folder):
    (folder / CHECKSUMS_FILE).unlink()
    return f"has no {CHECKSUMS_FILE}"


def replaces_the_checksums(text):
    def damage(folder):
        (folder / CHECKSUMS_FILE).write_text(text)
        return "is damaged"

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        cut_in_half,
        flip_one_bit,
        delete_one,
        add_one,
        delete_the_checksums,
        *map(replaces_the_checksums, ('{"crc32": {"val', "[1]", '{"crc32": {"values.json": []}}')),
    ],
)
def test_damage_is_found_and_named(folder, damage):
    with pytest.raises(DamagedFilesError, match=damage(folder)) as error:
        verify_checksums(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["other.pickle", "state.pt", "prefetch.pkl", "state.tdz"])
def test_files_that_a_library_would_unpickle_are_refused(folder, name):
    (folder / "part" / name).write_bytes(b"")
    for opened in (verify_checksums, write_checksums):
        with pytest.raises(ConfigError, match="is not opened"):
            opened(folder)


def test_checksums_are_computed_once_while_a_file_is_unchanged(folder, monkeypatch):
    computed = []
    crc32 = files.zlib.crc32
    monkeypatch.setattr(files.zlib, "crc32", lambda *args: computed.append(1) or crc32(*args))
    monkeypatch.setattr(files, "_SETTLED_S", 0)
    verify_checksums(folder)
    first = len(computed)
    verify_checksums(folder)
    assert len(computed) == first > 0
    file = weights_of(folder)
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(content[::-1])
    with pytest.raises(DamagedFilesError, match="was altered"):
        verify_checksums(folder)


def test_a_full_disk_is_an_error_of_the_system(tmp_path, monkeypatch):
    def full(*_):
        raise SafetensorError("Error while serializing: I/O error: No space left (os error 28)")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    with pytest.raises(OSError, match="No space left on device") as error:
        write_state(tmp_path / "state", STATE)
    assert error.value.errno == errno.ENOSPC


def test_other_values_are_no_state(tmp_path):
    with pytest.raises(TypeError, match="not set"):
        write_state(tmp_path / "state", {"names": {"a"}})


@pytest.mark.parametrize("target", [".", "nothing.json", "/dev/null"])
def test_links_to_anything_but_files_are_refused(folder, target):
    (folder / "link.json").symlink_to(target)
    with pytest.raises(ConfigError, match="is not opened"):
        verify_checksums(folder)


def test_links_to_files_are_followed(folder, tmp_path):
    """As in the cache of a hub, whose files have the names of their contents."""
    for number, path in enumerate(path for path in folder.rglob("*") if path.is_file()):
        path.rename(tmp_path / str(number))
        path.symlink_to(tmp_path / str(number))
    verify_checksums(folder)
    assert torch.equal(read_state(folder / "part")["weights"], weights)
    tampered = weights_of(folder)
    tampered.write_bytes(tampered.read_bytes()[::-1])
    with pytest.raises(DamagedFilesError, match="its checksum differs"):
        verify_checksums(folder)


def test_hidden_files_and_texts_are_ignored(folder):
    names = (".DS_Store", ".nfs0001", ".cache/hub/a.lock", ".git/a.pickle", "README.md", "note.txt")
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    verify_checksums(folder)
    write_checksums(folder)
    assert not set(names) & set(read_json(folder / CHECKSUMS_FILE)["crc32"])


def test_json_may_have_a_byte_order_mark(folder):
    path = folder / CHECKSUMS_FILE
    path.write_text(path.read_text(), encoding="utf-8-sig")
    verify_checksums(folder)


def test_a_folder_may_replace_the_one_before(folder, tmp_path):
    for stop in (True, False):
        with contextlib.suppress(KeyboardInterrupt), atomic_output(folder, replace=True) as scratch:
            write_state(scratch, {"step": 4})
            write_checksums(scratch)
            if stop:
                raise KeyboardInterrupt
        verify_checksums(folder)
        assert (folder / "part").exists() == stop
        assert list(tmp_path.iterdir()) == [folder]
    assert read_state(folder) == {"step": 4}


def test_an_empty_folder_may_be_a_link(folder, tmp_path):
    """To a larger disk, for example."""
    link, target = tmp_path / "link", tmp_path / "disk" / "empty"
    target.mkdir(parents=True)
    link.symlink_to(target)
    with atomic_output(link) as scratch:
        write_state(scratch, {"step": 4})
    assert link.is_symlink()
    assert read_state(target) == {"step": 4}
    assert {*tmp_path.iterdir()} == {folder, link, target.parent}
    assert list(target.parent.iterdir()) == [target]


def test_a_file_gets_its_place_after_the_files_beside_it(tmp_path, monkeypatch):
    """A process that is killed in between leaves a card without its file, not a file without it."""
    placed, replace = [], os.replace
    monkeypatch.setattr(
        files.os, "replace", lambda part, to: placed.append(to.name) or replace(part, to)
    )
    with atomic_output(tmp_path / "b.hdf5") as scratch:
        for name in ("a.json", "b.hdf5", "b.hdf5.card.json"):
            scratch.with_name(name).write_text("")
    assert len(placed) == 3
    assert placed[-1] == "b.hdf5"


def test_a_second_writer_is_refused(tmp_path):
    path = tmp_path / "demos"
    with atomic_output(path) as scratch:
        with (
            pytest.raises(
                ConfigError, match=f"process {os.getpid()} on .* writes .*/demos; choose"
            ),
            atomic_output(path),
        ):
            raise AssertionError("in the block")
        scratch.write_text("first")
    with pytest.raises(ConfigError, match="exists already"), atomic_output(path):
        raise AssertionError("in the block")
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "first"


_WRITER = """
import os, signal
from pathlib import Path
from ba_torchrl.core.files import atomic_output

with atomic_output(Path("demos")) as scratch:
    scratch.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_writer_that_was_killed_blocks_nobody(tmp_path):
    killed = run_script(tmp_path, _WRITER, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / ".demos.scratch/demos").exists()
    with atomic_output(tmp_path / "demos") as scratch:
        assert not scratch.exists()
        scratch.write_text("whole")
    assert {path.name for path in tmp_path.iterdir()} == {"demos", "script.py", "stdout", "stderr"}


def test_a_lock_that_cannot_name_its_process_is_deleted(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(files.os, "write", full)
    with pytest.raises(OSError, match=r"full.*/lock"):
        Lock(tmp_path / "lock", "works")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("code", "is_usable"), [(errno.ENOLCK, True), (errno.EIO, False)])
def test_a_file_system_without_locks_is_a_warning(code, is_usable, tmp_path, monkeypatch, caplog):
    def fails(*_):
        raise OSError(code, "no lock")

    monkeypatch.setattr(files.fcntl, "flock", fails)
    stops = contextlib.nullcontext() if is_usable else pytest.raises(OSError, match="no lock")
    with stops, atomic_output(tmp_path / "demos") as scratch:
        scratch.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["demos"] * is_usable
    (tmp_path / "lock").touch()
    with contextlib.nullcontext() if is_usable else pytest.raises(OSError, match="no lock"):
        assert lock_holder(tmp_path / "lock") is None
    assert len(caplog.messages) == is_usable


def test_a_lock_on_a_file_that_its_holder_deleted_is_none(tmp_path, monkeypatch):
    """The second opens the file, the first deletes it, and only then is it locked."""
    first, lock = Lock(tmp_path / "lock", "works"), fcntl.flock

    def late(*arguments):
        monkeypatch.undo()
        first.release()
        lock(*arguments)

    monkeypatch.setattr(files.fcntl, "flock", late)
    second = Lock(tmp_path / "lock", "works")
    with pytest.raises(ConfigError, match="works"):
        Lock(tmp_path / "lock", "works")
    second.release()
    assert not list(tmp_path.iterdir())


def test_a_process_that_asks_for_the_holder_keeps_nobody_out(tmp_path, monkeypatch):
    path = tmp_path / "lock"
    path.touch()  # of a process that was killed
    with path.open() as asking:
        fcntl.flock(asking, fcntl.LOCK_SH)
        monkeypatch.setattr(files.time, "sleep", lambda _: fcntl.flock(asking, fcntl.LOCK_UN))
        Lock(path, "works").release()


def test_a_file_is_replaced_when_it_is_complete(tmp_path):
    path, link = tmp_path / "new" / "film.mp4", tmp_path / "link.mp4"
    link.symlink_to(path)
    for content in ("old", "new"):
        with atomic_file(link) as scratch:
            assert scratch.suffix == path.suffix
            scratch.write_text(content)
    with contextlib.suppress(OSError), atomic_file(path) as scratch:
        scratch.write_text("torn")
        raise OSError
    assert path.read_text() == "new"
    assert link.is_symlink()
    assert list(path.parent.iterdir()) == [path]
    with atomic_file("/dev/null") as device:
        assert str(device) == "/dev/null"


def test_a_text_file_is_whole_or_not_there(tmp_path, monkeypatch):
    path = tmp_path / "result.json"
    write_text(path, "{}\n")
    monkeypatch.setattr(files.os, "fsync", lambda _: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        write_text(path, "x" * 100)
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        write_text("/dev/full", "x")
    assert json.loads(path.read_text()) == {}
    assert list(tmp_path.iterdir()) == [path]
