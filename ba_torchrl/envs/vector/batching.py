"""Vector: several environments as one TorchRL environment, in this process or in others."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from typing_extensions import Self

from ba_torchrl.envs.checks import ChecksPolicy, check_actions, check_seed
from ba_torchrl.envs.episode_positions import EpisodePosition

MakeEnv = Callable[[], EnvBase]


class Vector(ChecksPolicy, EnvBase):
    """Environments that step together, with batch size [num_workers].

    Actions are validated before any environment moves. Attributes and methods that this class does
    not have belong to the environments: ``vector.horizon`` is a list of their values, and
    ``vector.render()`` a list of results.

    Args:
        create_env_fn: builds one environment, or one such function per environment.
    """

    def __init__(self, num_workers: int, create_env_fn: MakeEnv | Sequence[MakeEnv]) -> None:
        if callable(create_env_fn):
            create_env_fn = [create_env_fn] * num_workers
        specs = {}
        for make_env in dict.fromkeys(create_env_fn):
            env = make_env()
            specs[make_env], description = env.specs.clone().to("cpu"), repr(env)
            supports_set_state = env._supports_set_state
            env.close(raise_if_closed=False)
        stacked = torch.stack([specs[make_env] for make_env in create_env_fn])
        super().__init__(
            device="cpu", batch_size=stacked.shape, allow_done_after_reset=supports_set_state
        )
        self.num_workers, self.create_env_fn = num_workers, list(create_env_fn)
        self.observation_spec = stacked["output_spec", "full_observation_spec"]
        self.reward_spec = stacked["output_spec", "full_reward_spec"]
        self.full_done_spec = stacked["output_spec", "full_done_spec"]
        self.state_spec = stacked["input_spec", "full_state_spec"]
        self.action_spec = stacked["input_spec", "full_action_spec"]
        self._base_seed: int | None = None
        self._description, self._supports_set_state = description, supports_set_state

    # -- for subclasses ----------------------------------------------------------------------

    @abstractmethod
    def start(self) -> None:
        """Make the environments; the first reset or seed does it otherwise."""

    @abstractmethod
    def _reset_some(self, options: Mapping[int, dict[str, Any]], *, is_full: bool) -> None:
        """Reset environments.

        Args:
            options: keywords of each environment's reset, by its index.
            is_full: all environments are reset, or with keywords of the caller.
        """

    @abstractmethod
    def _step_some(self, indices: Sequence[int], inputs: TensorDictBase) -> None:
        """Step the environments at ``indices`` with their rows of ``inputs``."""

    @abstractmethod
    def _outputs(self) -> TensorDict:
        """Return a copy of the last observation, reward and flags of each environment."""

    @abstractmethod
    def _seed_one(self, index: int, seed: int | None, static_seed: bool) -> int | None:
        """Seed an environment and return what its `set_seed` returns."""

    @abstractmethod
    def _call_each(
        self, method: str, arguments: Iterable[tuple[Any, ...]], **keywords: Any
    ) -> list[Any]:
        """Call a method of each environment and return the results."""

    @abstractmethod
    def _get_each(self, name: str) -> tuple[list[Any], bool]:
        """Return an attribute of each environment, and whether it is a method."""

    # -- public ------------------------------------------------------------------------------

    def get_state(self) -> TensorDict:
        """Return the state of each environment, for ``reset(state, set_state=True)``."""
        return torch.stack(self._call_each("get_state", [()] * self.num_workers))

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the environments as TorchRL's batched environments are.

        Each environment takes the seed that `set_seed` of the one before returned, which is
        ``seed`` itself with ``static_seed``.

        Args:
            seed: of the first environment; None for random seeds.
            static_seed: all environments have the same seed.

        Returns:
            The seed for the next environment, such as the first one of another vector.
        """
        if seed is not None:
            check_seed(seed)
        self._base_seed = seed
        for index in range(self.num_workers):
            seed = self._seed_one(index, seed, static_seed)
        return seed

    def set_consecutive_seeds(self, seed: int) -> None:
        """Seed environment i with ``seed + i``, as ``reset(seed=seed)`` does."""
        check_seed(seed)
        self._base_seed = int(seed)
        for index in range(self.num_workers):
            self._seed_one(index, int(seed) + index, True)

    def get_positions(self) -> list[EpisodePosition]:
        """Return the position of each environment in its episodes; see `RecordedPosition`."""
        return self._call_each("get_position", [()] * self.num_workers)

    def continue_from(self, positions: Sequence[EpisodePosition]) -> None:
        """Continue the episodes of `get_positions`; the next reset returns their observations.

        Args:
            positions: of as many environments of the same task and parameters.
        """
        self._call_each("continue_from", [(position,) for position in positions])

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_") or self.__dict__.get("is_closed", True):
                raise
        values, is_method = self._get_each(name)
        if not is_method:
            return values
        return lambda *args, **kwargs: self._call_each(name, [args] * self.num_workers, **kwargs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.num_workers} x {self._description})"

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # both would step the same environments

    # -- TorchRL -----------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        raise NotImplementedError  # `set_seed` does it

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | None = None,
        set_state: bool = False,
        **kwargs: Any,
    ) -> TensorDictBase:
        state = kwargs.pop("state", tensordict) if set_state else None
        each = kwargs.pop("list_of_kwargs", [{}] * self.num_workers)
        options = [{**kwargs, **own} for own in each]
        if seed is not None:
            check_seed(seed)
            self._base_seed = int(seed)
            options = [{**own, "seed": self._base_seed + i} for i, own in enumerate(options)]
        if set_state:
            given = TensorDict() if state is None else state
            rows = given.exclude(*self.reset_keys).expand(self.batch_size).unbind(0)
            options = [
                {"tensordict": row, "set_state": True, **own}
                for own, row in zip(options, rows, strict=True)
            ]
        given = tensordict.keys(True) if tensordict is not None else ()
        masks = [tensordict.get(key) for key in self.reset_keys if key in given]
        indices = self._any(masks) if masks else range(self.num_workers)
        is_full = not masks or any(options)
        self._reset_some({index: options[index] for index in indices}, is_full=is_full)
        return self._outputs().exclude(*self.reward_keys).to(self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_step", None)
        check_actions(tensordict.get(self.action_key, None), self.action_spec, mask)
        indices = range(self.num_workers) if mask is None else self._any([mask])
        self._step_some(indices, tensordict)
        outputs = self._outputs()
        if len(indices) < self.num_workers:
            others = sorted(set(range(self.num_workers)) - set(indices))
            for key in self.reward_keys:
                outputs.get(key)[others] = 0
        return outputs.to(self.device)

    def _any(self, masks: Iterable[torch.Tensor]) -> list[int]:
        """Return the indices of environments for which any entry of any mask [n, ...] is True."""
        flat = torch.cat([mask.reshape(self.num_workers, -1) for mask in masks], dim=1)
        return flat.any(dim=1).nonzero().flatten().tolist()


class SerialVectorEnv(Vector):
    """Environments that step sequentially in this process."""

    def start(self) -> None:
        self._envs = [make_env() for make_env in self.create_env_fn]
        self._last = [TensorDict({}, []) for _ in self._envs]
        self.is_closed = False

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments."""
        if self.is_closed and raise_if_closed:
            raise RuntimeError("the environments are closed already")
        for env in [] if self.is_closed else self._envs:
            env.close()
        super().close()

    def _reset_some(self, options: Mapping[int, dict[str, Any]], *, is_full: bool) -> None:
        if self.is_closed:
            self.start()
        for index, own in options.items():
            env = self._envs[index]
            state = env.reset(**own).select(*env.observation_keys, *env.done_keys)
            self._last[index] = state.update(env.full_reward_spec.zero())

    def _step_some(self, indices: Sequence[int], inputs: TensorDictBase) -> None:
        rows = inputs.exclude("_step", "next").unbind(0)
        for index in indices:
            self._last[index] = self._envs[index]._step(rows[index])

    def _outputs(self) -> TensorDict:
        return torch.stack(self._last)

    def _seed_one(self, index: int, seed: int | None, static_seed: bool) -> int | None:
        if self.is_closed:
            self.start()
        return self._envs[index].set_seed(seed, static_seed=static_seed)

    def _call_each(
        self, method: str, arguments: Iterable[tuple[Any, ...]], **keywords: Any
    ) -> list[Any]:
        pairs = zip(self._envs, arguments, strict=True)
        return [getattr(env, method)(*own, **keywords) for env, own in pairs]

    def _get_each(self, name: str) -> tuple[list[Any], bool]:
        values = [getattr(env, name) for env in self._envs]
        return values, callable(values[0])
