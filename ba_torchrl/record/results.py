"""Results of finished runs, one ``result.json`` per run folder.

`RunResult` is the schema. Reports are made from these files only.
"""

from __future__ import annotations

import contextlib
import platform
import subprocess
from collections.abc import Collection, Iterable, Mapping
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, ValidationError, model_validator
from typing_extensions import Self

from ba_torchrl import __version__
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.files import json_bytes, read_json, write_text

RESULT_FILE = "result.json"
CONFIG_FILE = "config.json"
FAILURE_FILE = "failure.json"
"""Written by a benchmark into the folder of a run that failed: ``reason``, ``when``, ``log``."""
CITABLE_EPISODES = 200
"""Least number of test episodes of a number that can be cited."""
Phase = Literal["demonstrations", "collection", "updates", "evaluation", "other"]
"""Phase of a run. "other" is the start, the saving of states, and the video."""
PACKAGES = ("torch", "torchrl", "tensordict", "pybullet", "numpy", "escnn")

NON_LEARNING_FIELDS = frozenset(
    {
        "plugins",
        "run_dir",
        "resume",
        "label",
        "benchmark",
        "device",
        "threads",
        "parallel",
        "start_method",
        "timeout_s",
        "max_restarts",
        "start_timeout_s",
        "save_minutes",
        "logger",
        "log_every",
        "video_episodes",
    }
)
"""Fields of a run's configuration that do not affect learning. A resumed run may have other values,
and reports average over runs that differ in them."""


class CurvePoint(StrictModel):
    """One evaluation of the greedy policy during the run."""

    updates: int
    """Gradient updates so far."""
    env_steps: int
    """Steps of all environments so far, demonstrations not counted."""
    seconds: float
    """Duration of the run so far, without interruptions."""
    episodes: int
    success_rate: float
    standard_error: float
    """Binomial standard error of the success rate over these episodes."""
    mean_length: float
    """Mean steps per episode, failed episodes included."""


class TestedPolicy(StrictModel):
    """A greedy policy in the episodes of a test, which neither trained nor selected it."""

    __test__: ClassVar[bool] = False  # no test of pytest

    updates: int
    """Gradient updates of the policy."""
    seeds: list[int]
    """Seed of each episode. Episodes with the same seed share their objects, and are a cluster."""
    successes: list[Literal[0, 1]]
    """Whether each episode reached the goal."""
    lengths: list[int]
    """Steps of each episode."""

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if not len(self.seeds) == len(self.successes) == len(self.lengths) > 0:
            raise ValueError("every episode has a seed, a success and a length")
        return self

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.seeds)

    @property
    def success_rate(self) -> float:
        """Fraction of episodes that reached the goal."""
        return sum(self.successes) / self.episodes

    @property
    def mean_length(self) -> float:
        """Mean steps per episode, failed episodes included."""
        return sum(self.lengths) / self.episodes

    @property
    def is_citable(self) -> bool:
        """Whether there are at least `CITABLE_EPISODES` episodes."""
        return self.episodes >= CITABLE_EPISODES


class RunResult(StrictModel):
    """Results and settings of a run, or the test of a policy from a file (``policy_file``).

    Of a policy from a file, `last` and `best` are both that policy, there is no curve, precision
    and hardware are those of the test, and what its card does not know of its training is None.
    """

    format: Literal[3] = 3
    """1: rates without the outcomes of episodes. 2: a configuration of another form."""
    protocol: int
    """Version of the protocol of the tests; see `ba_torchrl.training.protocol`."""
    task: str
    task_version: int
    expert_version: int | None
    """None: no expert took part in the training, or it is unknown which."""
    label: str
    """Name of the method, such as "sacfd equi"."""
    benchmark: str | None
    """The benchmark that the run belongs to."""
    seed: int
    curve: list[CurvePoint]
    """Evaluations in the order of updates, the first of the untrained policy."""
    last: TestedPolicy
    """The policy that training ends with: the main number."""
    best: TestedPolicy
    """The checkpoint with the best evaluation in `curve`, the newest of equal ones."""
    policy_file: str | None = None
    """SHA-256 of the file of the tested policy; None for a run."""
    demonstrations: int | None
    """Episodes of demonstrations."""
    demonstration_steps: int | None
    """Steps of these episodes."""
    env_steps: int | None
    """Steps of all environments, demonstrations and evaluations not counted."""
    expert_labels: int | None
    """States besides demonstrations that the expert labelled with its action."""
    precision: str
    """Number format in which the networks compute, "float32", "bfloat16" or "tf32"; "bfloat16, then
    float32" of a run that was resumed on another machine."""
    parameters: int
    """Parameters of the acting policy."""
    config: dict[str, Any]
    """The run's configuration, defaults included."""
    versions: dict[str, str]
    """Versions of Python and the packages, and the commit."""
    hardware: dict[str, Any]
    """`cpu`, `cores`, `memory_gb`, `gpu` (None on the CPU) and the learner's `threads`."""
    seconds: float | None
    """Wall time of the run, without interruptions."""
    phase_seconds: dict[Phase, float]
    """What `seconds` is the sum of. Collection in other processes during updates is not counted."""
    resumed_at: list[int] = Field(default_factory=list)
    """Updates after which the run was resumed."""
    finished: str
    """Time of the end of the run, UTC, ISO 8601."""
    files: dict[str, str]
    """Paths of `curve`, `checkpoint` of the last policy, the `best` one and optionally `video`,
    relative to the run folder."""


def write_result(folder: str | Path, result: RunResult) -> Path:
    """Write ``result.json`` into a run folder, atomically."""
    return write_text(Path(folder) / RESULT_FILE, result.model_dump_json(indent=2) + "\n")


def read_result(folder: str | Path) -> RunResult:
    """Read the result of a run folder."""
    path = Path(folder) / RESULT_FILE
    try:
        return RunResult.model_validate_json(json_bytes(path))
    except ValidationError as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{path} is not the result of a run: {reason}") from None


def run_folders(roots: Iterable[str | Path]) -> tuple[list[Path], list[Path]]:
    """Find the run folders below some folders, themselves included.

    Returns:
        The folders of finished runs and those of unfinished runs, both sorted.
    """
    roots = [Path(root) for root in roots]
    finished, *others = (
        {file.parent for root in roots for file in root.rglob(name)}
        for name in (RESULT_FILE, CONFIG_FILE, FAILURE_FILE)
    )
    return sorted(finished), sorted(set().union(*others) - finished)


def read_failure(folder: str | Path) -> str | None:
    """Return why a benchmark's last run in a folder failed, None if it did not fail."""
    path = Path(folder) / FAILURE_FILE
    try:
        return str(read_json(path)["reason"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # nested without end
        return f"{FAILURE_FILE} is damaged"


def why_unfinished(folder: str | Path) -> str:
    """Return why a run folder holds no result that can be read."""
    if (Path(folder) / RESULT_FILE).exists():
        return f"{RESULT_FILE} is damaged"
    return read_failure(folder) or "interrupted"


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by dotted name, such as "env.obs_size"."""
    out: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out


def differences(
    first: Mapping[str, Any],
    second: Mapping[str, Any],
    ignored: Collection[str] = NON_LEARNING_FIELDS,
) -> dict[str, tuple[Any, Any]]:
    """Return the settings in which the configurations of two runs differ, with both values."""
    a, b = (
        flat({key: value for key, value in config.items() if key not in ignored})
        for config in (first, second)
    )
    return {
        name: (a.get(name), b.get(name))
        for name in sorted(a.keys() | b.keys())
        if a.get(name) != b.get(name)
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect results.

    In a clone of the repository, ``commit`` is the package's, with a "+" if files are changed.
    """
    found = {"python": platform.python_version(), "ba_torchrl": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue  # escnn is optional
    root = Path(__file__).parents[2]
    if (root / ".git").exists():
        command = ["git", "-C", str(root), "describe", "--always", "--exclude=*", "--dirty=+"]
        with contextlib.suppress(OSError, subprocess.SubprocessError):  # git is not installed
            found["commit"] = subprocess.run(
                command, capture_output=True, text=True, check=True
            ).stdout.strip()
    return found


def now() -> str:
    """Return the current time, UTC, ISO 8601."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
