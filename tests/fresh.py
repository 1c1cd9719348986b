"""Scripts in processes that have imported torch and other libraries, and nothing of this package.

Each is forked from one server: it starts in milliseconds, `python script.py` in seconds.
"""

import atexit
import contextlib
import multiprocessing
import os
import runpy
import sys
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from subprocess import CompletedProcess

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        *("torch", *(f"torchrl.{name}" for name in ("collectors", "data", "envs", "modules"))),
        *("networkx", "numba", "pydantic", "scipy.spatial", "trimesh"),
    ]
)
TIMEOUT_S = 240


def run_script(
    folder: Path, code: str, paths: tuple[Path, ...] = (), *, check: bool = True
) -> CompletedProcess:
    """Run code in a folder as `python script.py` does; return exit code, stdout and stderr.

    Args:
        folder: where script.py is written; its modules can be imported.
        code: of the script.
        paths: further folders of modules.
        check: whether another exit code than 0 fails the test.
    """
    with script(folder, code, paths) as process:
        process.join(TIMEOUT_S)
    out, error = ((folder / name).read_text() for name in ("stdout", "stderr"))
    assert process.exitcode == 0 or not check, error[-3000:]
    return CompletedProcess(["script.py"], process.exitcode, out, error)


@contextlib.contextmanager
def script(folder: Path, code: str, paths: tuple[Path, ...] = ()) -> Iterator[BaseProcess]:
    """Start code in a folder as `run_script` does; yield its process, and kill it at the end."""
    path = folder / "script.py"
    path.write_text(code)
    process = CONTEXT.Process(target=_main, args=(path, (folder, *paths)))
    process.start()
    try:
        yield process
    finally:
        if process.exitcode is None:
            process.kill()
        process.join(TIMEOUT_S)


def _main(script: Path, paths: tuple[Path, ...]) -> None:
    os.chdir(script.parent)
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.environ["OMP_NUM_THREADS"] = "1"
    sys.path[:0] = map(str, paths)
    sys.argv = [str(script)]
    try:
        runpy.run_path(str(script), run_name="__main__")
    finally:
        atexit._run_exitfuncs()
