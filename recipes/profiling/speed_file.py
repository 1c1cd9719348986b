"""Files of measured rows, written and compared by `recipes/measure.py`."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Literal

import torch
from pydantic import ValidationError

from ba_torchrl.algorithms.compilation import CompileMode
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import json_bytes, write_text
from ba_torchrl.core.hardware import hardware, onednn_max_cpu_isa
from ba_torchrl.modules.layers import Precision
from ba_torchrl.record.results import now, versions
from profiling.table import Row

SHOWN_PACKAGES = ("torch", "torchrl", "pybullet")
_REPOSITORY = Path(__file__).parents[2]


class Machine(StrictModel):
    """Hardware, software and time of measurements."""

    cpu: str
    cores: int | None
    memory_gb: float | None
    gpu: str | None
    """None for learners on the CPU."""
    threads: int
    """Threads of torch."""
    onednn_max_cpu_isa: str | None
    """Environment variable that limits the instruction sets of oneDNN."""
    load_average: float | None
    """Of the minute before the measurements."""
    versions: dict[str, str]
    """Versions of Python and the packages."""
    commit: str | None
    """Of the package's repository, with "-dirty" if files differ from it; None without one."""
    date: str
    """UTC, ISO 8601."""

    @classmethod
    def here(cls, device: torch.device) -> Machine:
        """Return the description of this machine, now.

        Args:
            device: of the learners.
        """
        return cls(
            **hardware(device),
            onednn_max_cpu_isa=onednn_max_cpu_isa(),
            load_average=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            versions=versions(),
            commit=_commit(),
            date=now(),
        )

    def __str__(self) -> str:
        names = [self.cpu, f"{self.cores} cores", f"{self.threads} torch threads"]
        names += [name for name in (self.gpu,) if name is not None]
        packages = [
            f"{name} {self.versions[name]}" for name in SHOWN_PACKAGES if name in self.versions
        ]
        when = [self.date]
        when += [f"load average {self.load_average:.1f}"] if self.load_average is not None else []
        when += [f"commit {self.commit}"] if self.commit is not None else []
        return "; ".join(map(", ".join, (names, packages, when)))


class SpeedFile(StrictModel):
    """Content of a file of measured rows."""

    format: Literal[1] = 1
    machine: Machine
    precision: Precision = "auto"
    """Asked for the learners' networks."""
    compile_mode: CompileMode | None = None
    """Of the learners."""
    rows: list[Row]

    def __str__(self) -> str:
        compiled = "" if self.compile_mode is None else f", compile_mode {self.compile_mode}"
        return f"{self.machine}, precision {self.precision}{compiled}"


def write_speed_file(path: str | Path, content: SpeedFile) -> Path:
    """Write rows to a file, which appears when it is complete."""
    return write_text(path, content.model_dump_json(indent=1) + "\n")


def read_speed_file(path: str | Path) -> SpeedFile:
    """Read the rows of a file.

    Raises:
        ConfigError: it cannot be opened, or `write_speed_file` did not write it.
    """
    try:
        return SpeedFile.model_validate_json(json_bytes(path))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "content"
        raise ConfigError(
            f"{path} is not a file that recipes/measure.py wrote ({where}: {first['msg']})"
        ) from None


def _commit() -> str | None:
    if not (_REPOSITORY / ".git").exists():
        return None  # an installed package
    command = ["git", "-C", _REPOSITORY, "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None  # git is not installed
    return done.stdout.strip() or None
