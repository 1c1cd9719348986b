"""Runs at real limits of the operating system: size of files and number of open files."""

import contextlib
import errno
import os

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.cli import EXIT_CODE
from ba_torchrl.cli.errors import plain_errors
from ba_torchrl.core.files import write_text
from ba_torchrl.record.plots import Learning, plot_panels
from ba_torchrl.record.video import write_video
from ba_torchrl.training import policy as policies
from tests.training.test_resume import config_for, interrupt, run

resource = pytest.importorskip("resource")


@contextlib.contextmanager
def limited(name, value):
    """Lower the soft limit ``name`` to ``value``."""
    kind = getattr(resource, name)
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (value, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def test_a_state_that_cannot_be_written_leaves_the_one_before(tmp_path, caplog):
    config = config_for(tmp_path)
    interrupt(config, after=4)
    saved = max((tmp_path / "run" / "resume").glob("checkpoint-*"))
    before = {path: path.read_bytes() for path in saved.rglob("*") if path.is_file()}
    longer = config.model_copy(update={"resume": True})
    with (
        limited("RLIMIT_FSIZE", max(map(len, before.values())) // 2),
        pytest.raises(OSError, match="File too large") as error,
    ):
        run(longer)
    assert error.value.errno == errno.EFBIG
    assert "the state could not be saved" in caplog.text
    assert {path: path.read_bytes() for path in before} == before
    assert run(longer).updates == config.total_updates


def noise(frames=6):
    return np.random.default_rng(0).integers(0, 255, (frames, 96, 96, 3), np.uint8)


def save_policy(path):
    policy = ba_torchrl.load_policy("close_loop/block_picking")
    policies.save_policy(policy, path, policy.result.last)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("film.mp4", lambda path: write_video(path, noise(), fps=5)),
        ("film.gif", lambda path: write_video(path, noise(), fps=5)),
        (
            "curve.svg",
            lambda path: plot_panels({"a": {"b": Learning(((0, 1), (0, 1)))}}, [path], names="b"),
        ),
        ("page.md", lambda path: write_text(path, 10_000 * "x")),
        ("policy.safetensors", save_policy),
    ],
)
def test_a_file_that_cannot_be_written_leaves_the_one_before(name, write, tmp_path, capfd):
    path = tmp_path / name
    path.write_text("older")
    with limited("RLIMIT_FSIZE", 1024), pytest.raises(SystemExit) as end:
        plain_errors(write)(path)
    assert end.value.code == EXIT_CODE
    output = capfd.readouterr()
    assert output.err.startswith("error: ")
    assert (output.out + output.err).count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "older"
    write(path)
    assert path.stat().st_size > 1024
    assert list(tmp_path.iterdir()) == [path]


def lowest_free_handle():
    """Number that the next opened file gets; files above it may be open."""
    handle = os.dup(2)
    os.close(handle)
    return handle


def test_too_few_file_handles_are_one_line(capsys):
    @plain_errors
    def main(_):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 2, parallel=False).reset()

    with (
        limited("RLIMIT_NOFILE", lowest_free_handle()),
        pytest.raises(SystemExit) as end,
    ):
        main(None)
    assert end.value.code == EXIT_CODE
    line = capsys.readouterr().err
    assert "Too many open files" in line
    assert line.count("\n") == 1
