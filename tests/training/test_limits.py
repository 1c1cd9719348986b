"""Runs at real limits of the operating system: size of files and number of open files."""

import contextlib
import errno
import os

import pytest

import ba_torchrl
from ba_torchrl.cli import EXIT_CODE
from ba_torchrl.cli.errors import plain_errors
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
