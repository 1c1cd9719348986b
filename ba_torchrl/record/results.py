"""Results of finished runs, ``result.json`` in a run folder, and of policies, in their files.

`RunResult` is the schema of both. Reports are made from these files only, which somebody else may
have written: `read_result` reads them all, imports nothing, and refuses what no run can have.
"""

from __future__ import annotations

import contextlib
import os
import platform
import subprocess
from collections.abc import Collection, Iterable, Mapping
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator
from typing_extensions import Self

from ba_torchrl import __version__
from ba_torchrl.core.config import FIRST_TEST_SEED, PROTOCOL, Seed, StrictModel, explain
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import header_texts, json_bytes, read_json, write_text

RESULT_FILE = "result.json"
POLICY_SUFFIX = ".safetensors"
POLICY_RESULT = "result"
"""Name of the result in the header of a policy's file."""
POLICIES = Path(__file__).parents[1] / "policies"
"""Folder of the policies that the package ships; that of a task is ``TASK.safetensors``."""
CONFIG_FILE = "config.json"
FAILURE_FILE = "failure.json"
"""Written by a benchmark into the folder of a run that failed: ``reason``, ``when``, ``log``."""
CITABLE_EPISODES = 200
"""Least number of test episodes of a number that can be cited."""
Phase = Literal["demonstrations", "collection", "updates", "evaluation", "other"]
"""Phase of a run. "other" is the start, the saving of states, and the video."""
Count = Annotated[int, Field(ge=0, lt=2**53)]
"""A number of something; larger ones are not exact in JSON."""
Rate = Annotated[float, Field(ge=0, le=1)]
Amount = Annotated[float, Field(ge=0)]
PACKAGES = ("torch", "torchrl", "tensordict", "pybullet", "numpy")

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

    updates: Count
    """Gradient updates so far."""
    env_steps: Count
    """Steps of all environments so far, demonstrations not counted."""
    seconds: Amount
    """Duration of the run so far, without interruptions."""
    episodes: Annotated[Count, Field(ge=1)]
    success_rate: Rate
    standard_error: Rate
    """Binomial standard error of the success rate over these episodes."""
    mean_length: Amount
    """Mean steps per episode, failed episodes included."""


class PolicyTest(StrictModel):
    """Outcomes of a greedy policy in episodes that neither trained nor selected it."""

    updates: Count
    """Gradient updates of the policy."""
    seeds: list[Annotated[int, Field(ge=0, lt=2**63)]]
    """Seed of each episode. Episodes with the same seed share their objects, and are a cluster."""
    successes: list[Literal[0, 1]]
    """Whether each episode reached the goal."""
    lengths: list[Annotated[Count, Field(ge=1)]]
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


class Machine(StrictModel):
    """Hardware and package versions with which something was computed."""

    hardware: dict[str, Any]
    """As in `RunResult`."""
    versions: dict[str, str]
    """As in `RunResult`."""


class RunResult(StrictModel):
    """Results and settings of a run, or of a policy in a file (``policy_file``).

    Of a policy in a file, `last` and `best` are the same test, there is no curve, versions,
    precision and hardware are those of the test, and what is not known of its training is None.
    """

    format: Literal[3] = 3
    """1: rates without the outcomes of episodes. 2: a configuration of another form."""
    protocol: Count
    """Version of the protocol of the tests; see `ba_torchrl.training.protocol`."""
    task: str
    task_version: Count
    expert_version: Count | None
    """None: no expert took part in the training, or it is unknown which."""
    label: str
    """Name of the method, such as "sacfd equi"."""
    benchmark: str | None
    """The benchmark that the run belongs to."""
    seed: Seed
    curve: list[CurvePoint]
    """Evaluations in the order of updates, the first of the untrained policy."""
    last: PolicyTest
    """The policy that training ends with: the main number."""
    best: PolicyTest
    """The checkpoint with the best evaluation in `curve`, the newest of equal ones."""
    policy_file: str | None = None
    """SHA-256 of the weights in the policy's file; None for a run."""
    trained_on: Machine | None = None
    """Where the policy in a file was trained, if it is known; None for a run."""
    demonstrations: Count | None
    """Episodes of demonstrations."""
    demonstration_steps: Count | None
    """Steps of these episodes."""
    env_steps: Count | None
    """Steps of all environments, demonstrations and evaluations not counted."""
    expert_labels: Count | None
    """States besides demonstrations that the expert labelled with its action."""
    precision: str
    """Number format in which the networks compute, "float32", "bfloat16" or "tf32"; "bfloat16, then
    float32" of a run that was resumed on another machine."""
    parameters: Count
    """Parameters of the acting policy."""
    config: dict[str, Any]
    """The run's configuration, defaults included."""
    versions: dict[str, str]
    """Versions of Python and the packages, and the commit."""
    hardware: dict[str, Any]
    """`cpu`, `cores`, `memory_gb`, `gpu` (None on the CPU) and the learner's `threads`."""
    seconds: Amount | None
    """Wall time of the run, without interruptions."""
    phase_seconds: dict[Phase, Amount]
    """What `seconds` is the sum of. Collection in other processes during updates is not counted."""
    resumed_at: list[Count] = Field(default_factory=list)
    """Updates after which the run was resumed."""
    finished: str
    """Time of the end of the run, UTC, ISO 8601."""
    files: dict[str, str]
    """Paths of the `checkpoint` of the last policy, the `best` one, and the `curve` and the `video`
    if they could be made, relative to the run folder and inside it."""

    @field_validator("curve")
    @classmethod
    def _check_order(cls, curve: list[CurvePoint]) -> list[CurvePoint]:
        updates = [point.updates for point in curve]
        if updates != sorted(set(updates)):
            raise ValueError("the updates of the points do not rise")
        return curve

    @field_validator("versions")
    @classmethod
    def _check_versions(cls, versions: dict[str, str]) -> dict[str, str]:
        if missing := [name for name in ("python", "ba_torchrl") if not versions.get(name)]:
            raise ValueError(f"without the version of {' and '.join(missing)}")
        return versions

    @field_validator("config")
    @classmethod
    def _check_task(cls, config: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        task = info.data.get("task")
        if config.get("task", task) != task:
            raise ValueError(f"its task, {config['task']!r}, is not the result's")
        return config

    @field_validator("files")
    @classmethod
    def _check_files(cls, files: dict[str, str]) -> dict[str, str]:
        for path in map(PurePosixPath, files.values()):
            if path.is_absolute() or ".." in path.parts or "\0" in str(path):
                raise ValueError(f"{path} is not a path inside the run folder")
        return files

    @field_validator("last", "best")
    @classmethod
    def _check_seeds(cls, test: PolicyTest, info: ValidationInfo) -> PolicyTest:
        of_protocol = [*range(FIRST_TEST_SEED, FIRST_TEST_SEED + test.episodes)]
        if info.data.get("protocol") == PROTOCOL and test.seeds != of_protocol:
            raise ValueError(
                f"the seeds are not those of protocol {PROTOCOL}, {FIRST_TEST_SEED} and following"
            )
        return test

    @property
    def updates(self) -> int:
        """Gradient updates of the last policy."""
        return self.last.updates


def write_result(folder: str | Path, result: RunResult) -> Path:
    """Write ``result.json`` into a run folder, atomically."""
    return write_text(Path(folder) / RESULT_FILE, result.model_dump_json(indent=2) + "\n")


def read_result(path: str | Path, content: bytes | None = None) -> RunResult:
    """Read a result, which somebody else may have written, without the weights of a policy.

    Args:
        path: a run folder, its ``result.json``, or the ``.safetensors`` file of a policy.
        content: of a policy's file, if it has been read.

    Raises:
        ConfigError: the file cannot be read, or holds no result.
    """
    path = Path(path)
    file = path / RESULT_FILE if path.is_dir() else path
    try:
        is_policy = file.suffix == POLICY_SUFFIX
        text: str | bytes = _in_header(file, content) if is_policy else json_bytes(file)
        return RunResult.model_validate_json(text)
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror or error}") from None
    except ValidationError as error:
        problems = explain(error, RunResult, "result").problems
        more = f" (and {len(problems) - 1} more)" if problems[1:] else ""
        reason = " ".join(f"{problems[0][1]}{more}".split())
        raise ConfigError(f"{file} has no valid result: {reason}") from None


def _in_header(file: Path, content: bytes | None) -> str:
    """Return the text of the result in a policy's file."""
    texts = header_texts(file, content)
    if POLICY_RESULT not in texts:
        raise ConfigError(
            f"{file} holds no result; `ba-torchrl export` writes a policy with that of its test"
        )
    return texts[POLICY_RESULT]


def shipped_file(task: str) -> Path:
    """Return the file in which the package ships the policy of a task."""
    return POLICIES / f"{task}{POLICY_SUFFIX}"


def shipped_policies() -> list[str]:
    """Return the tasks for which the package ships a policy."""
    files = POLICIES.rglob(f"*{POLICY_SUFFIX}")
    return sorted(file.relative_to(POLICIES).with_suffix("").as_posix() for file in files)


def file_of(folder: Path, result: RunResult, name: str) -> Path | None:
    """Return a file of a run by its name in the result; None if the run has no such file, or one
    that a link leads out of the run folder to."""
    if name not in result.files:
        return None
    path, root = (folder / result.files[name]).resolve(), folder.resolve()
    return path if path.is_relative_to(root) and os.path.isfile(path) else None  # or a long name


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
        try:
            read_result(folder)
        except ConfigError as error:
            return str(error).removeprefix(f"{folder}{os.sep}")
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
            continue  # a nightly build has a name of its own
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
