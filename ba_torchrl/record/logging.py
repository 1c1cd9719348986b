"""Scalars of a run, in a CSV file and optionally a TorchRL logger."""

from __future__ import annotations

import csv
import logging
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ba_torchrl.record.results import flat

if TYPE_CHECKING:
    from tqdm import tqdm

Backend = Literal["csv", "tensorboard", "wandb"]
"""The file alone, or also one of TorchRL's loggers."""

SCALARS_FILE = "scalars.csv"
FILE_INTERVAL_S = 10.0
_COLUMNS = ("step", "name", "value")


class Series(NamedTuple):
    """One scalar over a run."""

    steps: np.ndarray
    """[n] int64, ascending."""
    values: np.ndarray
    """[n] float64."""


def limit_library_logs() -> None:
    """Set the log levels of libraries to warnings."""
    for name in ("torchrl", "lerobot"):
        logging.getLogger(name).setLevel(logging.WARNING)


def progress_bar(**settings: Any) -> tqdm:
    """Return a progress bar, with fewer updates if it is written to a file."""
    from tqdm import tqdm

    return tqdm(mininterval=0.1 if sys.stderr.isatty() else FILE_INTERVAL_S, **settings)


class ScalarLog:
    """Writes scalars to ``scalars.csv`` in the run folder and optionally to a TorchRL logger.

    The file has the columns step, name and value, one row per scalar, and is complete after each
    `write`. A resumed run appends to the same file. TorchRL's CSV logger is not used, because it
    writes one file without a header per scalar and keeps all values in memory. The configuration of
    the run, which may be nested, is logged as hyper-parameters.
    """

    def __init__(
        self, run_dir: str | Path, backend: Backend = "csv", config: Mapping[str, Any] | None = None
    ) -> None:
        run_dir = Path(run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        self.path = run_dir / SCALARS_FILE
        self.logger = None
        if backend != "csv":
            from torchrl.record.loggers import get_logger

            options = {"wandb_kwargs": {"project": "ba-torchrl"}} if backend == "wandb" else {}
            self.logger = get_logger(
                backend, logger_name=str(run_dir), experiment_name=run_dir.name, **options
            )
            known = (int, float, str)  # types that every backend supports
            settings = flat(config or {}).items()
            self.logger.log_hparams({k: v if isinstance(v, known) else str(v) for k, v in settings})
        _drop_incomplete_row(self.path)
        self._file = self.path.open("a", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, lineterminator="\n")
        if self._file.tell() == 0:
            self._writer.writerow(_COLUMNS)

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Write scalars, numbers or tensors of one element, after ``step`` gradient updates."""
        values = {name: float(value) for name, value in scalars.items()}
        self._writer.writerows((step, name, repr(value)) for name, value in values.items())
        self._file.flush()
        if self.logger is not None:
            for name, value in values.items():
                self.logger.log_scalar(name, value, step)

    def close(self) -> None:
        """Close the file and the logger; further calls have no effect."""
        self._file.close()
        if self.logger is not None:
            self.logger.close()
            self.logger = None


def read_scalars(path: str | Path) -> dict[str, Series]:
    """Read the scalars of a run from its folder or ``scalars.csv``.

    If a resumed run wrote a step twice, the later value is returned. An incomplete last row of a
    killed run is ignored.
    """
    path = Path(path)
    if path.is_dir():
        path /= SCALARS_FILE
    text = path.read_text(encoding="utf-8", errors="replace")
    rows = csv.reader(text[: text.rfind("\n") + 1].splitlines())
    if tuple(next(rows, ())) != _COLUMNS:
        raise ValueError(f"{path} does not start with the columns {', '.join(_COLUMNS)}")
    found: dict[str, dict[int, float]] = {}
    for number, row in enumerate(rows, start=2):
        try:
            step, name, value = row
            found.setdefault(name, {})[int(step)] = float(value)
        except ValueError:
            raise ValueError(f"{path}, line {number} is no step, name and value: {row}") from None
    return {
        name: Series(np.array(sorted(points)), np.array([points[step] for step in sorted(points)]))
        for name, points in found.items()
    }


def last_step(run_dir: str | Path) -> int | None:
    """Return the step of the last row in a run's scalars; None if there is none yet."""
    path = Path(run_dir) / SCALARS_FILE
    rows = path.read_bytes().split(b"\n") if path.exists() else []
    step = rows[-2].split(b",")[0] if len(rows) > 1 else b""
    return int(step) if step.isdigit() else None


def _drop_incomplete_row(path: Path) -> None:
    """Remove an incomplete last row, without a line end, of a killed run."""
    if path.exists():
        content = path.read_bytes()
        if not content.endswith(b"\n"):
            os.truncate(path, content.rfind(b"\n") + 1)
