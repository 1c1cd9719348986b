"""The simulator: PyBullet worlds, bodies, robots, controllers and cameras, without torch."""

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Context in which compiled code writes nothing to the standard output and error."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with contextlib.suppress(ValueError):  # a closed one
            stream.flush()
    try:
        kept = [os.dup(number) for number in (1, 2)]
    except OSError:  # a process without these streams
        yield
        return
    try:
        with open(os.devnull, "w") as sink:
            for number in (1, 2):
                os.dup2(sink.fileno(), number)
            yield
    finally:
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)


with _silent():  # PyBullet prints the time of its build
    import pybullet  # noqa: F401
