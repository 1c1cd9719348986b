"""Format: how a library names and stores the entries of demonstrations; and their card."""

from __future__ import annotations

import importlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, field_validator
from safetensors.numpy import load_file

from ba_torchrl.core import keys
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import (
    ConfigError,
    DamagedFilesError,
    MissingPackageError,
    in_one_line,
    install_command,
)
from ba_torchrl.core.files import (
    atomic_output,
    json_bytes,
    size_and_crc32,
    write_tensors,
    write_text,
)
from ba_torchrl.core.registry import Registry
from ba_torchrl.envs.registration import gym_id
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env

Arrays = dict[str, np.ndarray]
"""An episode of T steps: its entries by name, with T rows, and T + 1 rows of observations where the
observation after the last action is known."""


@dataclass(frozen=True)
class Rows:
    """An entry of an episode in a file, which is read when an array is made of it."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], Any]
    """Return its values."""
    fault: str = ""
    """Why it cannot be used."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Read the values."""
        try:
            return np.asarray(plain(self.read()), dtype)
        except ConfigError:
            raise
        except Exception as error:  # libraries raise anything at files that are damaged
            raise ConfigError(f"cannot be read: {in_one_line(error)}") from error

    def then(self, last: Any) -> Rows:
        """Return these rows and one more, the last one of ``last``."""
        shape = (sum(self.shape[:1]) + 1, *self.shape[1:])
        fault = self.fault or getattr(last, "fault", "")
        return replace(
            self,
            shape=shape,
            read=lambda: np.concatenate([self, np.asarray(last)[-1:]]),
            fault=fault,
        )


StoredArrays = Mapping[str, np.ndarray | Rows]
"""`Arrays` as a file has them."""
Role = Literal["observation", "action", "result"]
"""Of an entry: known before the step, chosen in it, or known after it."""
RESULTS = (keys.REWARD, keys.TERMINATED, keys.TRUNCATED, keys.SUCCESS)
"""Results of a step that files hold; ``done`` is terminated or truncated."""
_LAST_FILE = "last_observations.safetensors"
_EXACT_FILE = "observations.npz"


class Entry(StrictModel):
    """An entry of the episodes, and its name in the file."""

    name: str
    role: Role
    dtype: str
    """NumPy's name of the type; "str" for text."""
    shape: tuple[int, ...]
    """Of one step, channels of images first."""
    file_shape: tuple[int, ...] | None = None
    """Of one step in the file; None in cards that do not say it."""
    is_picture: bool = False
    """Whether policies of the library see it as a picture."""

    @property
    def is_image(self) -> bool:
        """Whether it has channels, rows and columns."""
        return len(self.shape) == 3


class Card(StrictModel):
    """What is known of a file of demonstrations."""

    card_format: Literal[3] = 3
    format: str
    task: str
    task_version: int
    expert_version: int
    """Of the task's expert when the demonstrations were made."""
    goal: str
    """Of the task, in one sentence."""
    robot: str
    source: str
    """How the demonstrations were made, such as "expert"; of a graded set, its grade."""
    policy: str = ""
    """Which acted, in words."""
    seed: int
    """Of the first episodes."""
    env: dict[str, Any]
    """Every parameter of the environment that affects the data."""
    episodes: int
    steps: int
    success_rate: float
    mean_return: float | None = None
    """Mean sum of an episode's rewards, without discount."""
    instructions: list[str]
    """The different sentences, at most 20 of them; an example if they were not observed."""
    depth: str = "float32 in metres, stored without loss: the largest error is 0"
    license: str = "MIT"
    versions: dict[str, str]
    """Of the packages that wrote the file."""
    entries: dict[str, Entry]
    """By key of the TensorDict."""
    left_out: list[str] = Field(default_factory=list)
    """Keys of the observations that were not chosen."""
    cameras: list[str] | None = None
    """Keys of the images that are pictures, if they were chosen."""
    checksums: dict[str, tuple[int, int]] = Field(default_factory=dict)
    """Length and CRC-32 of each file, by its path below the folder; of a single file, by "."."""

    @field_validator("entries")
    @classmethod
    def _check_entries(cls, entries: dict[str, Entry]) -> dict[str, Entry]:
        if missing := {keys.ACTION, *RESULTS} - entries.keys():
            raise ValueError(f"entries lack {', '.join(sorted(missing))}")
        for entry in entries.values():
            try:
                known = entry.dtype == "str" or np.dtype(entry.dtype).kind in "fiub"
            except TypeError:
                known = False
            if not known:
                raise ValueError(f"{entry.name} has the unknown type {entry.dtype!r}")
        return entries

    @property
    def prompt(self) -> str:
        """The first instruction, else the task's goal."""
        return next(iter(self.instructions), "") or self.goal

    @property
    def resolved_env(self) -> ResolvedEnv:
        """The environment of the demonstrations."""
        return resolve_env(self.task, self.env)

    def to_markdown(self) -> str:
        """Return the card as a page, with the fields that the Hugging Face Hub reads."""
        rows = {
            "task": f"`{self.task}` (Gymnasium: `{gym_id(self.task)}`): {self.goal}",
            "version": f"{self.task_version}, expert {self.expert_version}",
            "robot": self.robot,
            "demonstrations": f"{self.source}, first seed {self.seed}",
            "policy": self.policy or self.source,
            "size": f"{self.episodes} episodes, {self.steps} steps",
            "success": f"{self.success_rate:.3f}",
            "mean return": "unknown" if self.mean_return is None else f"{self.mean_return:.3f}",
            "instructions": "; ".join(self.instructions) or "none",
            "depth and heights": self.depth,
            "licence": self.license,
            "versions": ", ".join(f"{name} {version}" for name, version in self.versions.items()),
        }
        lines = ["---", f"license: {self.license.lower()}", "task_categories: [robotics]"]
        lines += [f"tags: [{FORMATS[self.format].tag}, BulletArm, imitation-learning]", "---", ""]
        lines += [f"# Demonstrations of {self.task}", "", "| | |", "|---|---|"]
        lines += [f"| {name} | {value} |" for name, value in rows.items()]
        lines += ["", "| name | meaning | type | shape of a step |", "|---|---|---|---|"]
        for key, entry in self.entries.items():
            shape = entry.shape if entry.file_shape is None else entry.file_shape
            lines.append(
                f"| `{entry.name}` | {entry.role} `{key}` | {entry.dtype} | {list(shape)} |"
            )
        return "\n".join(lines) + "\n" + FORMATS[self.format].page(self)


class Format(ABC):
    """A library's format of demonstrations, registered under its name."""

    channels_last: ClassVar[bool] = False
    """Whether images are stored with their channels last."""
    has_last_observation: ClassVar[bool] = True
    """Whether the observation after the last action has a place; if not, a file beside holds it."""
    holds_texts: ClassVar[bool] = False
    """Whether it has a place for texts other than the instruction."""
    before_first_step: ClassVar[str | None] = None
    """Prefix of the entries that have a row before the first step, as observations have."""
    tag: ClassVar[str] = "BA-TorchRL"
    """Of data sets of this format on the Hugging Face Hub."""
    has_pictures: ClassVar[bool] = False
    """Whether images are also pictures for policies, which ``cameras`` chooses."""
    suffixes: ClassVar[tuple[str, ...]] = ()
    """Of its files, one of which a path must have; none for folders."""
    package: ClassVar[str]
    """The package to install."""
    hint: ClassVar[str] = ""
    """What else that package needs."""

    @abstractmethod
    def matches(self, path: Path) -> bool:
        """Return whether a file or folder looks as if it had this format."""

    @abstractmethod
    def names(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Return the names of entries in the file, after the library's convention, by key."""

    def file_shape(self, entry: Entry) -> tuple[int, ...]:
        """Return the shape of a step of an entry in the file."""
        if self.channels_last and entry.is_image:
            return (*entry.shape[1:], entry.shape[0])
        return entry.shape

    def is_beside(self, entry: Entry) -> bool:
        """Return whether the values of an entry are in a file of our own, without loss."""
        return False

    def page(self, card: Card) -> str:
        """Return what the page of the card says of this format only."""
        return ""

    def has_row_before_first_step(self, name: str) -> bool:
        """Return whether an entry of that name may have a row before the first step."""
        return self.before_first_step is not None and name.startswith(self.before_first_step)

    @abstractmethod
    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write episodes, whose entries have their names in the file, to a new path."""

    @abstractmethod
    def read(self, path: Path) -> Sequence[StoredArrays]:
        """Return the episodes of a file, with all of its entries by name.

        `Rows` are read later, if they are needed.
        """

    def library(self, module: str) -> Any:
        """Import a module of the library."""
        try:
            return importlib.import_module(module)
        except ImportError as error:
            raise MissingPackageError(
                f"this format needs a package that is not installed ({error})",
                install_command(self.package) + self.hint,
            ) from error


FORMATS: Registry[Format] = Registry("format", "ba_torchrl.demonstrations.formats", Format)


def find_format(path: Path) -> Format | None:
    """Return the format of a file or folder of demonstrations; None if it has none of these."""
    return next((FORMATS[name] for name in FORMATS if FORMATS[name].matches(path)), None)


def write_file(form: Format, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
    """Write episodes with their card; they appear under their name when all is on the disk."""
    import torch

    named: list[Arrays] = []
    beside: list[Arrays] = []
    for arrays in episodes:
        moved = {}
        beside.append({})
        for key, values in arrays.items():
            entry = card.entries[key]
            if form.is_beside(entry):
                beside[-1][entry.name] = values
            is_moved = form.channels_last and entry.is_image
            moved[entry.name] = np.moveaxis(values, 1, -1) if is_moved else values
        named.append(moved)
    with atomic_output(path) as scratch:
        form.write(scratch, named, card)
        if not form.has_last_observation:
            observed = [
                entry.name
                for entry in card.entries.values()
                if entry.role == "observation"
                and entry.dtype != "str"
                and not form.is_beside(entry)
            ]
            last = {
                name: torch.from_numpy(np.ascontiguousarray([arrays[name][-1] for arrays in named]))
                for name in observed
            }
            if last:
                write_tensors(scratch / _LAST_FILE, last)
        if beside[0]:
            rows = {name: np.concatenate([each[name] for each in beside]) for name in beside[0]}
            np.savez_compressed(scratch / _EXACT_FILE, **rows)
        card = card.model_copy(update={"checksums": _checksums(scratch)})
        write_text(page_file(scratch), card.to_markdown())
        write_text(card_file(scratch), card.model_dump_json(indent=1) + "\n")


def read_card(path: Path) -> Card | None:
    """Return the card of a file of demonstrations; None if it has none."""
    file = card_file(path)
    if not file.exists():
        return None
    try:
        text = json_bytes(file)
        values = json.loads(text)
        if not isinstance(values, dict) or not {"format", "entries"} <= values.keys():
            return None  # somebody else's file of that name
        if values.get("card_format") != Card.model_fields["card_format"].default:
            raise ConfigError(f"{file} is of another version; export the demonstrations again")
        card = Card.model_validate_json(text)
    except ConfigError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        what: Any = error
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(f"{file} is damaged: {what}") from None
    return card


def _checksums(path: Path) -> dict[str, tuple[int, int]]:
    """Return length and CRC-32 of the files of an export, by their paths below it."""
    files = [file for file in [path, *sorted(path.rglob("*"))] if file.is_file()]
    return {file.relative_to(path).as_posix(): size_and_crc32(file) for file in files}


def check_files(path: Path, card: Card) -> None:
    """Check that an export consists of the files of its card, unaltered."""
    for name, (size, checksum) in card.checksums.items():
        file = path / name
        if not file.is_file():
            raise DamagedFilesError(f"{file} is missing")
        if size_and_crc32(file) != (size, checksum):
            raise DamagedFilesError(
                f"{file} was altered: {size} bytes were written, of another checksum; if it was on "
                f"purpose, delete 'checksums' in {card_file(path)}"
            )


def read_file(form: Format, path: Path) -> list[StoredArrays]:
    """Return the episodes of a file, with all of its entries by name."""
    try:
        episodes = form.read(path)
        last_file = path / _LAST_FILE
        last = load_file(last_file) if path.is_dir() and last_file.exists() else {}
        if path.is_dir() and (path / _EXACT_FILE).exists():
            with np.load(path / _EXACT_FILE) as beside:
                episodes = _with_rows(episodes, {name: beside[name] for name in beside.files})
        return [
            {
                name: rows_of(values).then(last[name][i : i + 1]) if name in last else values
                for name, values in arrays.items()
            }
            for i, arrays in enumerate(episodes)
        ]
    except ConfigError:
        raise
    except Exception as error:  # libraries raise anything at files that are not theirs
        raise ConfigError(f"{path} cannot be read: {in_one_line(error)}") from error


def _with_rows(episodes: Sequence[StoredArrays], beside: Arrays) -> list[StoredArrays]:
    """Return episodes with the entries of the file beside, which have a row more than actions."""
    lengths = [len(np.asarray(arrays[keys.ACTION])) + 1 for arrays in episodes]
    for name, rows in beside.items():
        if len(rows) != sum(lengths):
            raise ConfigError(
                f"{_EXACT_FILE} has {len(rows)} rows of {name}, needed {sum(lengths)}: one for "
                "each step, and one after each episode"
            )
    ends = np.cumsum(lengths)
    return [
        {**arrays, **{name: rows[end - length : end] for name, rows in beside.items()}}
        for arrays, end, length in zip(episodes, ends, lengths, strict=True)
    ]


@contextmanager
def naming_episode(path: Path, number: int) -> Iterator[None]:
    """Begin the message of a `ConfigError` with the file and the episode."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}, episode {number}: {error}") from None


def check_rows(what: str, rows: int, steps: int, is_observed: bool) -> None:
    """Check that there is a row for each step, of observations perhaps also one after the last."""
    if rows - steps not in ((0, 1) if is_observed else (0,)):
        raise ConfigError(f"{what} has {rows} rows, and there are {steps} actions")


def entry_of(arrays: StoredArrays, name: str) -> np.ndarray | Rows:
    """Return an entry of a file."""
    if name not in arrays:
        raise ConfigError(f"there is no {name!r}. Known: {', '.join(sorted(arrays))}")
    if fault := getattr(arrays[name], "fault", ""):
        raise ConfigError(fault)
    return arrays[name]


def plain(values: Any) -> np.ndarray:
    """Return an array of numbers or of text, which libraries also return as bytes and objects."""
    array = np.asarray(values)
    if array.dtype.kind == "T":
        return array.astype(str)
    if array.dtype.kind not in "OS":
        return array
    texts = [text.decode() if isinstance(text, bytes) else text for text in array.reshape(-1)]
    if not all(isinstance(text, str) for text in texts):
        raise ConfigError("holds objects, neither numbers nor text")
    return np.array(texts, dtype=str).reshape(array.shape)


def flatten(name: str, values: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays in nested dictionaries and tuples, with names such as ``a/b/0``."""
    if isinstance(values, tuple):
        values = dict(enumerate(values))
    if isinstance(values, Mapping):
        for key, part in values.items():
            yield from flatten(f"{name}/{key}", part)
    elif values is not None:
        yield name, values


def rows_of(values: Any) -> Rows:
    """Return values, such as an array or a list, as `Rows`."""
    if isinstance(values, Rows):
        return values
    array = np.asarray(values)
    return Rows(array.shape, array.dtype, lambda: array)


def card_file(path: Path) -> Path:
    """Return the path of the card of a file or folder."""
    return path / "card.json" if path.is_dir() else path.with_name(f"{path.name}.card.json")


def page_file(path: Path) -> Path:
    """Return the path of the card of a file or folder as a page."""
    return path / "README.md" if path.is_dir() else path.with_name(f"{path.name}.card.md")
