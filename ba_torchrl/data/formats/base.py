"""Format: how a library names and stores the entries of demonstrations; and their card."""

from __future__ import annotations

import importlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, ValidationError, field_validator
from safetensors.numpy import load_file

from ba_torchrl.config import StrictModel
from ba_torchrl.data.files import complete_only, json_bytes, write_tensors, write_text
from ba_torchrl.envs import keys
from ba_torchrl.envs.registration import gym_id
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.errors import ConfigError, MissingPackageError, install_command
from ba_torchrl.registry import Registry

Arrays = dict[str, np.ndarray]
"""An episode of T steps: its entries by name, with T rows, and T + 1 rows of observations where the
observation after the last action is known."""
Role = Literal["observation", "action", "result"]
"""Of an entry: known before the step, chosen in it, or known after it."""
RESULTS = (keys.REWARD, keys.TERMINATED, keys.TRUNCATED, keys.SUCCESS)
"""Results of a step that files hold; ``done`` is terminated or truncated."""
_LAST_FILE = "last_observations.safetensors"


class Entry(StrictModel):
    """An entry of the episodes, and its name in the file."""

    name: str
    role: Role
    dtype: str
    """NumPy's name of the type; "str" for text."""
    shape: tuple[int, ...]
    """Of one step, channels of images first."""

    @property
    def is_image(self) -> bool:
        """Whether it has channels, rows and columns."""
        return len(self.shape) == 3


class Card(StrictModel):
    """What is known of a file of demonstrations."""

    format: str
    task: str
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
        lines += ["tags: [LeRobot, BulletArm, imitation-learning]", "---", ""]
        lines += [f"# Demonstrations of {self.task}", "", "| | |", "|---|---|"]
        lines += [f"| {name} | {value} |" for name, value in rows.items()]
        lines += ["", "| name | meaning | type | shape of a step |", "|---|---|---|---|"]
        lines += [
            f"| `{entry.name}` | {entry.role} `{key}` | {entry.dtype} | {list(entry.shape)} |"
            for key, entry in self.entries.items()
        ]
        return "\n".join(lines) + "\n"


class Format(ABC):
    """A library's format of demonstrations, registered under its name."""

    channels_last: ClassVar[bool] = False
    """Whether images are stored with their channels last."""
    has_last_observation: ClassVar[bool] = True
    """Whether the observation after the last action has a place; if not, a file beside holds it."""
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

    @abstractmethod
    def write(self, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
        """Write episodes, whose entries have their names in the file, to a new path."""

    @abstractmethod
    def read(self, path: Path) -> list[Arrays]:
        """Return the episodes of a file, with all of its entries by name."""

    def library(self, module: str) -> Any:
        """Import a module of the library.

        Raises:
            MissingPackageError: it is not installed.
        """
        try:
            return importlib.import_module(module)
        except ImportError as error:
            raise MissingPackageError(
                f"this format needs a package that is not installed ({error}): "
                f"{install_command(self.package)}{self.hint}"
            ) from error


FORMATS: Registry[Format] = Registry("format", "ba_torchrl.data.formats")


def find_format(path: Path) -> Format | None:
    """Return the format of a file or folder of demonstrations; None if it has none of these."""
    return next((FORMATS[name] for name in FORMATS if FORMATS[name].matches(path)), None)


def write_file(form: Format, path: Path, episodes: Sequence[Arrays], card: Card) -> None:
    """Write episodes with their card; they appear under their name when all is on the disk.

    Args:
        form: of the file.
        path: new file or folder.
        episodes: their entries by key.
        card: of the episodes.
    """
    named = []
    for arrays in episodes:
        moved = {}
        for key, values in arrays.items():
            entry = card.entries[key]
            is_moved = form.channels_last and entry.is_image
            moved[entry.name] = np.moveaxis(values, 1, -1) if is_moved else values
        named.append(moved)
    with complete_only(path) as scratch:
        form.write(scratch, named, card)
        if not form.has_last_observation:
            observed = [
                entry.name
                for entry in card.entries.values()
                if entry.role == "observation" and entry.dtype != "str"
            ]
            last = {
                name: torch.from_numpy(np.ascontiguousarray([arrays[name][-1] for arrays in named]))
                for name in observed
            }
            write_tensors(scratch / _LAST_FILE, last)
        write_text(page_file(scratch), card.to_markdown())
        write_text(card_file(scratch), card.model_dump_json(indent=1) + "\n")


def read_card(path: Path) -> Card | None:
    """Return the card of a file of demonstrations; None if it has none.

    Raises:
        ConfigError: the card is damaged.
    """
    file = card_file(path)
    if not file.exists():
        return None
    try:
        text = json_bytes(file)
        values = json.loads(text)
        if not isinstance(values, dict) or not {"format", "entries"} <= values.keys():
            return None  # somebody else's file of that name
        return Card.model_validate_json(text)
    except (OSError, ValueError, RecursionError) as error:
        what: Any = error
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(f"{file} is damaged: {what}") from None


def read_file(form: Format, path: Path) -> list[Arrays]:
    """Return the episodes of a file, with all of its entries by name.

    Raises:
        ConfigError: it is damaged, or a package is missing.
    """
    try:
        episodes = form.read(path)
        last_file = path / _LAST_FILE
        last = load_file(last_file) if path.is_dir() and last_file.exists() else {}
        return [
            arrays
            | {name: np.concatenate([arrays[name], rows[i : i + 1]]) for name, rows in last.items()}
            for i, arrays in enumerate(episodes)
        ]
    except ConfigError:
        raise
    except Exception as error:  # libraries raise anything at files that are not theirs
        raise ConfigError(
            f"{path} cannot be read: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        ) from error


def plain(values: Any) -> np.ndarray:
    """Return an array of numbers or of text, which libraries also return as bytes and objects."""
    array = np.asarray(values)
    if array.dtype.kind not in "OS":
        return array
    texts = [text.decode() if isinstance(text, bytes) else str(text) for text in array.reshape(-1)]
    return np.array(texts, dtype=str).reshape(array.shape)


def card_file(path: Path) -> Path:
    """Return the path of the card of a file or folder."""
    return path / "card.json" if path.is_dir() else path.with_name(f"{path.name}.card.json")


def page_file(path: Path) -> Path:
    """Return the path of the card of a file or folder as a page."""
    return path / "README.md" if path.is_dir() else path.with_name(f"{path.name}.card.md")


class Source(StrictModel):
    """Where the values of an entry come from, in a mapping of somebody else's demonstrations."""

    source: str
    """Name in the file."""
    components: list[int] | None = None
    """Indices along the last axis, in their new order; None for all."""
    scale: float | list[float] = 1.0
    """Factor, of all components or of each."""
    offset: float | list[float] = 0.0
    """Added after scaling."""

    def values(self, arrays: Arrays) -> np.ndarray:
        """Return the entry's values in an episode.

        Raises:
            ConfigError: the file has no such entry, or fewer components.
        """
        if self.source not in arrays:
            raise ConfigError(f"there is no {self.source!r}. Known: {', '.join(sorted(arrays))}")
        found = arrays[self.source]
        try:
            if self.components is not None:
                found = found[..., self.components]
            if self.scale == 1.0 and self.offset == 0.0:
                return found
            return found * np.asarray(self.scale) + np.asarray(self.offset)
        except (IndexError, ValueError, TypeError) as error:
            raise ConfigError(f"{self.source}, {found.shape}: {error}") from None


class DemonstrationMapping(StrictModel):
    """By key of the TensorDict, the name in the file, or a `Source`."""

    entries: dict[str, Source] = Field(min_length=1)

    @classmethod
    def parse(cls, mapping: str | Path | Mapping[str, Any]) -> DemonstrationMapping:
        """Return a mapping that is given as a YAML file or as its values.

        Raises:
            ConfigError: the file cannot be read, or a value is wrong.
        """
        what: Any = "mapping"
        if not isinstance(mapping, Mapping):
            what, mapping = mapping, _read_yaml(Path(mapping))
        if not isinstance(mapping, Mapping):
            raise ConfigError(f"{what}: must map keys to names in the file, got {mapping!r}")
        given = {
            str(key): {"source": value} if isinstance(value, str) else value
            for key, value in mapping.items()
        }
        try:
            return cls.model_validate({"entries": given})
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"][1:]))
            raise ConfigError(f"{what}: {where}: {first['msg']}") from None


def _read_yaml(path: Path) -> Any:
    try:
        import yaml
    except ImportError as error:
        fix = f"mappings need a package that is not installed: {install_command('omegaconf')}"
        raise MissingPackageError(fix) from error
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: {' '.join(str(error).split())}") from None
