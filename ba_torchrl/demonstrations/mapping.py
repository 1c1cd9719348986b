"""Files of other programs: a mapping says which of their entries are those of an environment."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, model_validator
from torchrl.data import NonTensor, TensorSpec, Unbounded

from ba_torchrl.core import keys
from ba_torchrl.core.config import StrictModel, parse
from ba_torchrl.core.errors import ConfigError, MissingPackageError, install_command
from ba_torchrl.demonstrations.formats.base import (
    RESULTS,
    Arrays,
    Format,
    StoredArrays,
    check_rows,
    entry_of,
    naming_episode,
    plain,
    read_file,
)
from ba_torchrl.demonstrations.plausibility import contradictions
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import ResolvedEnv

logger = logging.getLogger(__name__)

_NOT_OBSERVED = {*keys.STEP_FLAGS, keys.STEP_COUNT, *keys.OF_EXPERT, keys.INSTRUCTION}
_ONE_PER_ACTION = {keys.ACTION, *RESULTS}
_RESULT = Unbounded((1,), device="cpu", dtype=torch.float64)
_TOLERANCE = 1e-4
"""Part of a range by which values may exceed it, for rounding."""
Number = Annotated[float, Field(strict=False)]
"""A number, also as the text that YAML 1.1 makes of ``1e-3``."""


class EntrySource(StrictModel):
    """Where the values of an entry come from; a mapping may have the name alone."""

    source: str
    """Name in the file."""
    components: list[int] | None = None
    """Indices along the last axis, in their new order; None for all."""
    scale: Number | list[Number] = 1.0
    """Factor, of all components or of each."""
    offset: Number | list[Number] = 0.0
    """Added after scaling."""

    @model_validator(mode="before")
    @classmethod
    def _take_name(cls, given: Any) -> Any:
        return {"source": given} if isinstance(given, str) else given

    def values(self, found: np.ndarray) -> np.ndarray:
        """Return the values of an entry of an episode, from those in the file."""
        try:
            if self.components is not None:
                last = found.shape[-1] if found.ndim > 1 else 0
                # NumPy does not check the indices of an array without rows
                if out := [i for i in self.components if not -last <= i < last]:
                    raise ValueError(f"components {out} are not among its {last}")
                found = found[..., self.components]
            if self.scale == 1.0 and self.offset == 0.0:
                return found
            return found * np.asarray(self.scale) + np.asarray(self.offset)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{self.source}, {found.shape}: {error}") from None


def _sources(mapping: str | Path | Mapping[str, Any]) -> dict[str, EntrySource]:
    """Return the source of each key, of a mapping that is given as a YAML file or as its values."""
    is_file = not isinstance(mapping, Mapping)
    what, values = (mapping, _read_yaml(Path(mapping))) if is_file else ("mapping", mapping)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{what}: must map keys to names in the file, got {values!r}")
    return {str(key): parse(EntrySource, value, f"{what}: {key}") for key, value in values.items()}


def _read_yaml(path: Path) -> Any:
    try:
        import yaml
    except ImportError as error:
        what = "mappings need a package that is not installed"
        raise MissingPackageError(what, install_command("omegaconf")) from error
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: {' '.join(str(error).split())}") from None


class MappedFile:
    """A file of somebody else, whose mapped entries get the types and shapes of an environment.

    Args:
        mapping: of the entries, see `import_demonstrations`.
    """

    def __init__(
        self,
        form: Format,
        path: Path,
        resolved: ResolvedEnv,
        mapping: str | Path | Mapping[str, Any],
    ) -> None:
        self._form, self._path, self._resolved = form, path, resolved
        self._sources = _sources(mapping)
        with closing(make(resolved)) as env:
            self._specs, self._vectors, self._images = entry_specs(env), env.declared, env.images
        self._is_sparse = resolved.config.reward == "sparse"
        self._has_reward_only = keys.SUCCESS not in self._sources and keys.REWARD in self._sources
        needed = {*self._specs, *({keys.INSTRUCTION} & {*resolved.config.observations})}
        needed |= set() if self._is_sparse else {keys.REWARD, keys.TERMINATED}
        known = {*self._specs, *RESULTS, keys.INSTRUCTION}
        unknown, missing = self._sources.keys() - known, needed - self._sources.keys()
        for owner, names in (("environment", unknown), ("mapping", missing)):
            if names:
                raise ConfigError(
                    f"{path}: the {owner} has no {', '.join(sorted(names))}. "
                    f"Known: {', '.join(sorted(known))}"
                )

    def count(self) -> int:
        """Return the number of episodes, after the checks that need no values."""
        return len([*self._episodes(reads=False)])

    def read(self) -> list[Arrays]:
        """Return the entries of each episode until its first success or end."""
        episodes = [*self._episodes(reads=True)]
        if not episodes:
            raise ConfigError(f"{self._path} holds no episodes")
        for message in (*self._suspicious(episodes), *contradictions(episodes, self._resolved)):
            logger.warning("%s: %s", self._path, message)
        if self._is_sparse and self._has_reward_only and _has_rewards(episodes):
            episodes = [{**each, keys.SUCCESS: each[keys.REWARD]} for each in episodes]
        steps = sum(len(arrays[keys.ACTION]) for arrays in episodes)
        for number, arrays in enumerate(episodes):
            with naming_episode(self._path, number):
                episodes[number] = with_results(arrays, self._resolved)
        if left_out := steps - sum(len(arrays[keys.ACTION]) for arrays in episodes):
            logger.warning(
                "%s: %d of %d steps are left out, those after the first success or end of an "
                "episode",
                self._path,
                left_out,
                steps,
            )
        return episodes

    def _episodes(self, *, reads: bool) -> Iterator[Arrays]:
        """Yield the mapped entries of each episode with the types and shapes of the environment.

        Args:
            reads: False to check shapes only; the arrays have no rows.
        """
        for number, stored in enumerate(read_file(self._form, self._path)):
            with naming_episode(self._path, number):
                arrays = self._entries(stored, reads=False)  # before any value is read
                yield self._entries(stored, reads=True) if reads else arrays

    def _entries(self, stored: StoredArrays, *, reads: bool) -> Arrays:
        arrays, rows = {}, {}
        for key, source in self._sources.items():
            try:
                found = entry_of(stored, source.source)
                rows[key] = sum(found.shape[:1])
                if not reads:
                    found = plain(np.empty((0, *found.shape[1:]), found.dtype))
                arrays[key] = self._fitted(key, source.values(np.asarray(found)))
            except ConfigError as error:
                raise ConfigError(f"{key}: {error}") from None
        steps = rows[keys.ACTION]
        for key in arrays.keys() - {keys.INSTRUCTION}:
            has_first = self._form.has_row_before_first_step(self._sources[key].source)
            if key in RESULTS and rows[key] == steps + 1 and has_first:
                arrays[key], rows[key] = arrays[key][1:], steps
            check_rows(key, rows[key], steps, key not in _ONE_PER_ACTION)
        if not steps:
            raise ConfigError("there are no actions")
        return arrays

    def _fitted(self, key: str, values: np.ndarray) -> np.ndarray:
        """Return the values of an entry as the environment, or the step's result, has them."""
        if key == keys.INSTRUCTION:
            if values.dtype.kind not in "US":
                raise ConfigError("is no text")
            return values
        values = _fitted(values, self._specs.get(key, _RESULT))
        if key in self._vectors:
            return self._vectors[key].fitted(values)
        is_flag = key in RESULTS and (key != keys.REWARD or self._is_sparse)
        if is_flag and (np.minimum(abs(values), abs(values - 1.0)) > _TOLERANCE).any():
            raise ConfigError(
                f"has values from {values.min():g} to {values.max():g}, needed 0 or 1; set scale "
                "and offset, or another source"
            )
        return values

    def _suspicious(self, episodes: Sequence[Arrays]) -> Iterator[str]:
        """Yield sentences on entries that are one number in the whole file, and on more zeros than
        the environment's images have, points at the origin included."""
        for key, spec in self._specs.items():
            first, is_points = episodes[0][key].flat[0], key == keys.POINT_CLOUD
            is_flag = spec.dtype == torch.bool or key == keys.IN_HAND  # which are often 0
            if not is_flag and all((arrays[key] == first).all() for arrays in episodes):
                yield f"{key} is {first:g} in all steps; is it the right entry?"
            most = self._images[key].max_zeros if key in self._images else float(not is_points)
            if most >= 1:
                continue
            zeros, count = 0, 0
            for arrays in episodes:  # one at a time, since the images may fill the memory
                is_zero = arrays[key] == 0
                is_zero = is_zero.all(-1) if is_points else is_zero
                zeros, count = zeros + is_zero.sum(), count + is_zero.size
            if zeros > most * count:
                yield (
                    f"{100 * zeros / count:.0f} % of {key} is 0 m, which cameras write where they "
                    f"measure nothing; the environment has at most {100 * most:.0f} %. Fill in "
                    "these values"
                )
        if self._has_reward_only and not _has_rewards(episodes):
            yield (
                "the rewards are all 0, and every episode counts as a success: map success, or "
                "leave out reward, which follows from it"
            )


def entry_specs(env: BulletArmEnv) -> dict[str, TensorSpec]:
    """Return the specifications of an environment's observations and actions, by key."""
    specs = {
        key: spec
        for key, spec in env.observation_spec.items()
        if key not in _NOT_OBSERVED and not isinstance(spec, NonTensor)
    }
    return {**specs, keys.ACTION: env.action_spec}


def _has_rewards(episodes: Sequence[Arrays]) -> bool:
    return any(arrays[keys.REWARD].any() for arrays in episodes)


def _fitted(values: np.ndarray, spec: TensorSpec) -> np.ndarray:
    """Return values with the type and the shape that an environment has.

    Numbers become flags where they exceed 0.5; channels of images may be last; an axis of one, for
    a channel or at the end, may be missing. Values beyond the range by no more than rounding are
    clipped.
    """
    shape = tuple(spec.shape)
    if values.ndim and (*values.shape[1:], 1) == shape:
        values = values[..., None]
    if values.ndim == 3 and (1, *values.shape[1:]) == shape:
        values = values[:, None]
    if values.shape[1:] != shape and len(shape) == 3 == values.ndim - 1:
        values = np.moveaxis(values, -1, 1)
    if values.shape[1:] != shape:
        hint = "; set components" if len(shape) == 1 else ""
        raise ConfigError(f"has the shape {list(values.shape[1:])}, needed {list(shape)}{hint}")
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
        raise ConfigError(
            "has values that are no finite numbers; set components, or another source"
        )
    if spec.dtype == torch.bool:
        return values if values.dtype == bool else values > 0.5
    low, high = (getattr(spec.space, name, None) for name in ("low", "high"))
    if values.dtype.kind == "f" and not spec.dtype.is_floating_point:
        # Zeros alone are black in either range.
        if high is not None and (high == 255).all() and 0 < values.max(initial=0) <= 1:
            raise ConfigError("has values from 0 to 1, needed 0 to 255; set scale: 255")
        values = values.round()
    if low is not None and high is not None:
        slack = _TOLERANCE * (high - low).numpy()
        if (values < low.numpy() - slack).any() or (values > high.numpy() + slack).any():
            raise ConfigError(
                f"has values from {values.min():g} to {values.max():g}, needed "
                f"{low.min().item():g} to {high.max().item():g}; set scale and offset"
            )
        values = values.clip(low.numpy(), high.numpy())
    return values.astype(torch.empty(0, dtype=spec.dtype, device="cpu").numpy().dtype, copy=False)


def with_results(arrays: Arrays, resolved: ResolvedEnv) -> Arrays:
    """Return an episode until its first success or end, with the results of its steps, which its
    file may lack."""
    marks = [arrays[key] > 0.5 for key in RESULTS if key in arrays and key != keys.REWARD]
    ends = np.flatnonzero(np.any(marks, axis=0)) if marks else ()
    steps = int(ends[0]) + 1 if len(ends) else len(arrays[keys.ACTION])
    out = {
        key: values[: steps + (key not in _ONE_PER_ACTION)]
        for key, values in arrays.items()
        if key != keys.INSTRUCTION
    }
    is_last = np.arange(steps)[:, None] == steps - 1

    def flags(key: str, default: np.ndarray) -> np.ndarray:
        return out[key] > 0.5 if key in out else default

    success = flags(keys.SUCCESS, is_last)
    ends_at_limit = is_last & resolved.task_class.terminates_at_limit
    terminated = flags(keys.TERMINATED, success | ends_at_limit)
    reward_kind = resolved.config.reward
    if reward_kind == "sparse" or (reward_kind == "difference" and keys.SUCCESS in out):
        terminated = terminated | success
    unmarked = is_last & ~terminated  # also where the file marks no end
    truncated = flags(keys.TRUNCATED, unmarked) | unmarked
    reward = np.asarray(out.get(keys.REWARD, success), dtype=np.float32)
    if reward_kind == "sparse" and keys.SUCCESS in out:
        reward = reward.round()
        if len(wrong := np.flatnonzero(reward != success)):
            raise ConfigError(
                f"step {wrong[0]} of {steps} has the reward {reward[wrong[0], 0]:g} and the "
                f"success {int(success[wrong[0], 0])}; leave out reward, which follows from success"
            )
    out |= dict(zip(RESULTS, (reward, terminated, truncated, success), strict=True))
    if keys.INSTRUCTION in arrays:
        texts = {*arrays[keys.INSTRUCTION].astype(str).reshape(-1).tolist()}
        if len(texts) != 1 or not all(texts):
            raise ConfigError(
                f"instruction: found {sorted(texts)[:3]}, needed one sentence that remains the "
                "same in an episode"
            )
        out[keys.INSTRUCTION] = np.array([*texts])
    return out
