"""Files of other programs: a mapping says which of their entries are those of an environment."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError, field_validator
from torchrl.data import NonTensor, TensorSpec

from ba_torchrl.core import keys
from ba_torchrl.core.config import StrictModel
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

_NOT_OBSERVED = {*keys.STEP_FLAGS, keys.STEP_COUNT, keys.EXPERT_ACTION, keys.INSTRUCTION}
_TOLERANCE = 1e-4
"""Part of a range by which values may exceed it, for rounding."""


class Source(StrictModel):
    """Where the values of an entry come from."""

    source: str
    """Name in the file."""
    components: list[int] | None = None
    """Indices along the last axis, in their new order; None for all."""
    scale: float | list[float] = 1.0
    """Factor, of all components or of each."""
    offset: float | list[float] = 0.0
    """Added after scaling."""

    @field_validator("scale", "offset", mode="before")
    @classmethod
    def _read_text(cls, given: Any) -> Any:
        """Read ``1e-3``, which is text in YAML 1.1."""
        if isinstance(given, list):
            return [float(value) if isinstance(value, str) else value for value in given]
        return float(given) if isinstance(given, str) else given

    def values(self, found: np.ndarray) -> np.ndarray:
        """Return the values of an entry of an episode, from those in the file."""
        try:
            if self.components is not None:
                if found.ndim < 2:
                    raise IndexError("has one number per step, no components")
                last = found.shape[-1]  # NumPy does not check the indices of an array without rows
                if out := [i for i in self.components if not -last <= i < last]:
                    raise IndexError(f"components {out} are out of bounds")
                found = found[..., self.components]
            if self.scale == 1.0 and self.offset == 0.0:
                return found
            return found * np.asarray(self.scale) + np.asarray(self.offset)
        except (IndexError, ValueError, TypeError) as error:
            raise ConfigError(f"{self.source}, {found.shape}: {error}") from None


_SOURCES = TypeAdapter(dict[str, Source])


def _sources(mapping: str | Path | Mapping[str, Any]) -> dict[str, Source]:
    """Return the source of each key, of a mapping that is given as a YAML file or as its values."""
    what: Any = "mapping"
    if not isinstance(mapping, Mapping):
        what, mapping = mapping, _read_yaml(Path(mapping))
    if not isinstance(mapping, Mapping) or not mapping:
        raise ConfigError(f"{what}: must map keys to names in the file, got {mapping!r}")
    given = {
        str(key): {"source": value} if isinstance(value, str) else value
        for key, value in mapping.items()
    }
    try:
        return _SOURCES.validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{what}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


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
        with opened(resolved) as env:
            self._specs = _specs_of(env)
            self._vectors, self._images = env.declared, env.images
        self._is_sparse = resolved.config.reward == "sparse"
        known = {*self._specs, *RESULTS, keys.INSTRUCTION}
        if unknown := self._sources.keys() - known:
            raise ConfigError(
                f"{path}: the environment has no {', '.join(sorted(unknown))}. "
                f"Known: {', '.join(sorted(known))}"
            )
        needed = {*self._specs, *({keys.INSTRUCTION} & {*resolved.config.observations})}
        if not self._is_sparse:
            needed |= {keys.REWARD, keys.TERMINATED}
        if missing := needed - self._sources.keys():
            raise ConfigError(f"{path}: the mapping has no {', '.join(sorted(missing))}")

    def count(self) -> int:
        """Return the number of episodes, after the checks that need no values."""
        return len(self._episodes(reads=False))

    def read(self) -> list[Arrays]:
        """Return the entries of each episode until its first success or end."""
        episodes = self._episodes(reads=True)
        if not episodes:
            raise ConfigError(f"{self._path} holds no episodes")
        self._warn_of_constants(episodes)
        self._warn_of_zeros(episodes)
        for message in contradictions(episodes, self._resolved):
            logger.warning("%s: %s", self._path, message)
        if keys.REWARD in self._sources and keys.SUCCESS not in self._sources:
            if not any(arrays[keys.REWARD].any() for arrays in episodes):
                logger.warning(
                    "%s: the rewards are all 0, and every episode counts as a success: map "
                    "success, or leave out reward, which follows from it",
                    self._path,
                )
            elif self._is_sparse:
                for arrays in episodes:
                    arrays[keys.SUCCESS] = arrays[keys.REWARD]
        steps = _num_steps(episodes)
        for number, arrays in enumerate(episodes):
            with naming_episode(self._path, number):
                episodes[number] = with_results(_until_end(arrays), self._resolved)
        if (left := _num_steps(episodes)) < steps:
            logger.warning(
                "%s: %d of %d steps are left out, those after the first success or end of an "
                "episode",
                self._path,
                steps - left,
                steps,
            )
        return episodes

    def _episodes(self, *, reads: bool) -> list[Arrays]:
        """Return the mapped entries of each episode; see `_entries`."""
        episodes = []
        for number, stored in enumerate(read_file(self._form, self._path)):
            with naming_episode(self._path, number):
                entries = self._entries(stored, reads=False)  # before any value is read
                episodes.append(self._entries(stored, reads=True) if reads else entries)
        return episodes

    def _entries(self, stored: StoredArrays, *, reads: bool) -> Arrays:
        """Return the mapped entries of an episode with the types and shapes of the environment.

        Args:
            reads: False to check shapes only; the returned arrays have no rows.
        """
        arrays, rows = {}, {}
        for key, source in self._sources.items():
            try:
                found = entry_of(stored, source.source)
                shape = found.shape
                if not reads:
                    found = plain(np.empty((0, *shape[1:]), found.dtype))
                values = source.values(np.asarray(found))
                if key in self._specs:
                    values = _fitted(values, self._specs[key])
                    if key in self._vectors:
                        values = self._vectors[key].fitted(values)
                elif key in RESULTS:
                    values = _one_number(values)
                    if key != keys.REWARD or self._is_sparse:
                        _check_zero_or_one(values)
                elif values.dtype.kind not in "US":
                    raise ConfigError("is no text")
                arrays[key], rows[key] = values, sum((values.shape if reads else shape)[:1])
            except ConfigError as error:
                raise ConfigError(f"{key}: {error}") from None
        steps = rows[keys.ACTION]
        for key in arrays.keys() - {keys.INSTRUCTION}:
            name, is_result = self._sources[key].source, key in RESULTS
            if is_result and rows[key] == steps + 1 and self._form.has_row_before_first_step(name):
                arrays[key], rows[key] = arrays[key][1:], steps
            check_rows(key, rows[key], steps, not is_result and key != keys.ACTION)
        if not steps:
            raise ConfigError("there are no actions")
        return arrays

    def _warn_of_constants(self, episodes: Sequence[Arrays]) -> None:
        """Warn of an action or an observation that is one number in the whole file."""
        for key, spec in self._specs.items():
            first = episodes[0][key].flat[0]
            if spec.dtype == torch.bool or key == keys.IN_HAND:  # which are often 0
                continue
            if all((arrays[key] == first).all() for arrays in episodes):
                logger.warning(
                    "%s: %s is %g in all steps; is it the right entry?", self._path, key, first
                )

    def _warn_of_zeros(self, episodes: Sequence[Arrays]) -> None:
        """Warn of more zeros than the environment's images have, and of points at the origin."""
        for key in self._specs:
            most = self._images[key].max_zeros if key in self._images else 1.0
            is_points = key == keys.POINT_CLOUD
            if most >= 1 and not is_points:
                continue
            most, zeros, count = 0.0 if is_points else most, 0, 0
            for arrays in episodes:  # one at a time, since the images may fill the memory
                is_zero = arrays[key] == 0
                is_zero = is_zero.all(-1) if is_points else is_zero
                zeros, count = zeros + is_zero.sum(), count + is_zero.size
            if (share := zeros / count) > most:
                logger.warning(
                    "%s: %.0f %% of %s is 0 m, which cameras write where they measure nothing; the "
                    "environment has at most %.0f %%. Fill in these values",
                    self._path,
                    100 * share,
                    key,
                    100 * most,
                )


def entry_specs(resolved: ResolvedEnv) -> dict[str, TensorSpec]:
    """Return the specifications of an environment's observations and actions, by key."""
    with opened(resolved) as env:
        return _specs_of(env)


@contextmanager
def opened(resolved: ResolvedEnv) -> Iterator[BulletArmEnv]:
    """Make an environment, and close it."""
    env = make(resolved)
    try:
        yield env
    finally:
        env.close()


def _specs_of(env: BulletArmEnv) -> dict[str, TensorSpec]:
    specs = {
        key: spec
        for key, spec in env.observation_spec.items()
        if key not in _NOT_OBSERVED and not isinstance(spec, NonTensor)
    }
    return {**specs, keys.ACTION: env.action_spec}


def _num_steps(episodes: Sequence[Arrays]) -> int:
    return sum(len(arrays[keys.ACTION]) for arrays in episodes)


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
        raise ConfigError(f"has the shape {list(values.shape[1:])}, needed {list(shape)}")
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
        raise ConfigError("has values that are no finite numbers")
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


def _one_number(values: np.ndarray) -> np.ndarray:
    """Return results of the steps as [T, 1]."""
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
        raise ConfigError(
            "has values that are no finite numbers; needed one number per step: set components, "
            "or another source"
        )
    if not values.ndim or values.shape[1:] not in ((), (1,)):
        raise ConfigError(
            f"has the shape {list(values.shape[1:])}, needed one number per step; set components"
        )
    return values.reshape(-1, 1)


def _check_zero_or_one(values: np.ndarray) -> None:
    """Check that results are 0 or 1, but for rounding."""
    if (np.minimum(abs(values), abs(values - 1.0)) > _TOLERANCE).any():
        raise ConfigError(
            f"has values from {values.min():g} to {values.max():g}, needed 0 or 1; set scale and "
            "offset, or another source"
        )


def _until_end(arrays: Arrays) -> Arrays:
    """Return an episode until its first step with a success or an end."""
    steps = len(arrays[keys.ACTION])
    marks = [arrays[key] > 0.5 for key in RESULTS if key in arrays and key != keys.REWARD]
    ends = np.flatnonzero(np.any(marks, axis=0)) if marks else ()
    if not len(ends):
        return arrays
    steps = int(ends[0]) + 1
    kept = {key: steps + (key not in (*RESULTS, keys.ACTION)) for key in arrays}
    return {
        key: values if key == keys.INSTRUCTION else values[: kept[key]]
        for key, values in arrays.items()
    }


def with_results(arrays: Arrays, resolved: ResolvedEnv) -> Arrays:
    """Return an episode with the results of its steps, which its file may lack."""
    reward_kind = resolved.config.reward
    steps = len(arrays[keys.ACTION])
    is_last = np.arange(steps)[:, None] == steps - 1

    def flags(key: str, default: np.ndarray) -> np.ndarray:
        return arrays[key] > 0.5 if key in arrays else default

    success = flags(keys.SUCCESS, is_last)
    ends_at_limit = is_last & resolved.task_class.terminates_at_limit
    terminated = flags(keys.TERMINATED, success | ends_at_limit)
    if reward_kind == "sparse" or (reward_kind == "difference" and keys.SUCCESS in arrays):
        terminated = terminated | success
    ends = is_last & ~terminated  # also where the file marks no end
    truncated = flags(keys.TRUNCATED, ends) | ends
    reward = np.asarray(arrays.get(keys.REWARD, success), dtype=np.float32)
    if reward_kind == "sparse" and keys.SUCCESS in arrays:
        reward = reward.round()
        if (reward != success).any():
            step = int(np.flatnonzero(reward != success)[0])
            raise ConfigError(
                f"step {step} of {steps} has the reward {reward[step].item():g} and the success "
                f"{int(success[step].item())}; leave out reward, which follows from success"
            )
    results = (reward, terminated, truncated, success)
    out = arrays | dict(zip(RESULTS, results, strict=True))
    if keys.INSTRUCTION in arrays:
        texts = {*arrays[keys.INSTRUCTION].astype(str).reshape(-1).tolist()}
        if len(texts) != 1 or not all(texts):
            raise ConfigError(
                f"instruction: found {sorted(texts)[:3]}, needed one sentence that remains the "
                "same in an episode"
            )
        out[keys.INSTRUCTION] = np.array([*texts] * (steps + 1))
    return out
