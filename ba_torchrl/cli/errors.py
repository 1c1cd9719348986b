"""How commands report errors: on one line, without traceback, with exit code 2."""

from __future__ import annotations

import errno
import functools
import sys
from collections.abc import Callable
from typing import Any

from omegaconf.errors import OmegaConfBaseException

from ba_torchrl.cli import EXIT_CODE, plain_ends
from ba_torchrl.core.errors import ConfigError, as_os_error

_OF_RESOURCES = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ESTALE),
    *(errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP),
    *(errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.ENOMEM, errno.EAGAIN, errno.EMFILE, errno.ENFILE),
}
"""Numbers of errors of the system that a user can mend; others are of defects of the program."""


def plain_errors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function: errors of configuration and of resources are printed without traceback.

    Resources are memory, disk space, file handles, permissions and names of files. The exit code is
    `ba_torchrl.cli.EXIT_CODE`.
    """

    @functools.wraps(function)
    def decorated(*args: Any, **kwargs: Any) -> Any:
        try:
            with plain_ends():
                return function(*args, **kwargs)
        except (ConfigError, OmegaConfBaseException, OSError, MemoryError, RuntimeError) as error:
            text = _text(error)
            if text is None:
                raise
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            sys.stderr.write(f"error: {'; '.join(lines).replace(':; ', ': ')}\n")
            sys.exit(EXIT_CODE)

    return decorated


def _text(error: Exception) -> str | None:
    """Return what is printed of an error; None of one that is a defect of the program."""
    if isinstance(error, ConfigError):
        return str(error)
    if isinstance(error, OmegaConfBaseException):  # a missing value, or a wrong interpolation
        return str(error).partition("\n")[0]
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # of torch
        return f"out of memory: {error}"
    of_system = error if isinstance(error, OSError) else as_os_error(error)
    if of_system is None or of_system.errno not in _OF_RESOURCES:
        return None
    return f"out of memory: {of_system}" if of_system.errno == errno.ENOMEM else str(of_system)
