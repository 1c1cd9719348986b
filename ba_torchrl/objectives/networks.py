"""The networks of losses: their mode, new initial parameters, and how buffers of targets move."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, ClassVar, Literal, TypeVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from ba_torchrl.core.errors import BatchError, ConfigError, check_choice, layout
from ba_torchrl.core.evaluation_mode import evaluation_copy

Updater = TypeVar("Updater", bound=TargetNetUpdater)
Reduction = Literal["none", "mean", "sum"]
"""How the losses of a batch's samples are combined, as in TorchRL."""


class EvalModeTargetsLoss(LossModule):
    """A loss whose networks compute in evaluation mode where there is no gradient.

    They do so for targets, and for the whole loss under `torch.no_grad`. Elsewhere they are in the
    mode in which they were given, usually training mode.
    """

    reduction: Reduction
    _without_flag: ClassVar[str] = ""
    """What to do with a batch that lacks the flag of demonstrations."""

    def convert_to_functional(
        self, module: nn.Module, module_name: str, *args: Any, **kwargs: Any
    ) -> None:
        """Convert a network as TorchRL does, and keep a copy in evaluation mode as well."""
        super().convert_to_functional(module, module_name, *args, **kwargs)
        self.__dict__[f"{module_name}_in_evaluation_mode"] = evaluation_copy(
            self.__dict__[module_name]
        )

    def network(self, name: str) -> Any:
        """Return a network, in evaluation mode if gradients are disabled."""
        return self.__dict__[name if torch.is_grad_enabled() else f"{name}_in_evaluation_mode"]

    @torch.no_grad()
    def reset_parameters_recursive(self) -> None:
        """Draw the parameters of all networks anew; targets get the same values.

        Layers draw theirs by ``reset_parameters``, as torch's do. Coefficients of the loss, such as
        an entropy temperature, keep their values.

        Warns:
            UserWarning: parameters have no such layer and keep their values.
        """
        kept: set[str] = set()
        for name, part in self.named_children():
            if not isinstance(part, TensorDictParams):
                kept |= _not_reset(part)
                _reset_parameters(part)
            elif not name.startswith("target_"):
                network = self.__dict__[name.rpartition("_")[0]]
                kept |= _not_reset(network)
                for params in part.data.unbind(0) if part.ndim else (part.data,):
                    with params.to_module(network, preserve_module_state=False):
                        _reset_parameters(network)
        for name, part in self.named_children():
            if name.startswith("target_"):
                part.data.update_(getattr(self, name.removeprefix("target_")).data)
        if kept:
            names = ", ".join(sorted(kept))
            warnings.warn(f"{names}: parameters kept, without reset_parameters", stacklevel=2)

    def _prepare(self, tensordict: TensorDictBase, key: NestedKey, own_dims: int) -> None:
        """Check a batch, and give tensors that were passed by name a batch size.

        Args:
            tensordict: of samples.
            key: of an entry whose dimensions are those of the batch and, last, ``own_dims``.
        """
        missing = self._missing(tensordict)
        if missing:
            found = ", ".join(map(repr, sorted(tensordict.keys(True, True), key=str)))
            is_flag = getattr(self.tensor_keys, "is_demonstration", None) in missing
            raise BatchError(
                f"{type(self).__name__}: the batch lacks {', '.join(map(repr, missing))}; it has "
                f"{found or 'no entries'}{self._without_flag if is_flag else ''}"
            )
        value = tensordict.get(key)
        dims = value.ndim - own_dims
        if not tensordict.batch_size:
            tensordict.auto_batch_size_(max(0, dims))
        shape = list(tensordict.batch_size)
        if 0 in shape:
            raise BatchError(f"{type(self).__name__}: the batch is empty")
        if dims < len(shape):
            raise BatchError(
                f"{type(self).__name__}: {key!r} is {layout(value.dtype, value.shape)}, and must "
                f"have {len(shape) + own_dims} dimensions, {own_dims} after the batch's {shape}"
            )

    def _missing(self, tensordict: TensorDictBase) -> list[NestedKey]:
        """Return the keys of the entries that `forward` needs and a batch lacks."""
        return [key for key in self.in_keys if tensordict.get(key, None) is None]

    def _require(
        self, key: NestedKey, value: Tensor, dtype: torch.dtype | None, *shapes: Sequence[int]
    ) -> None:
        """Raise `BatchError` unless an entry has a type, if any is given, and one of the shapes."""
        if dtype not in (None, value.dtype) or list(value.shape) not in map(list, shapes):
            wanted = " or ".join(layout(dtype or value.dtype, shape) for shape in shapes)
            raise BatchError(
                f"{type(self).__name__}: {key!r} is {layout(value.dtype, value.shape)}, and must "
                f"be {wanted}"
            )

    def _of_one_dimension(self, tensordict: TensorDictBase, *written: NestedKey) -> TensorDictBase:
        """Return the loss of a batch of any shape, by `forward` of its samples in one dimension.

        Args:
            written: keys of entries that `forward` writes into its input.
        """
        shape = tensordict.batch_size
        samples = tensordict.reshape(shape.numel())
        out = self.forward(samples)
        for key in written:
            tensordict.set(key, samples[key].reshape(*shape, *samples[key].shape[1:]))
        if self.reduction == "none":
            for key, losses in out.items():
                if losses.ndim:
                    out.set(key, losses.reshape(shape))
        return out


_INSTEAD = {
    "get_dist": "a ProbabilisticActor, such as squashed_gaussian_policy(actor, in_keys)",
    "out_keys": "TensorDictModule(network, in_keys, out_keys)",
    "action_dims": "a QValueActor, or SpatialValues(network, actions)",
    "module.encoder": 'TensorDictModule(ChunkFlow(encoder, head), [*in_keys, "noise"], out_keys)',
}
"""By the attribute of a network that a loss uses, what has it."""


def check_network(name: str, network: object, attribute: str) -> None:
    """Raise `ConfigError` unless a loss's argument with a name is a network with ``in_keys`` and an
    attribute that the loss uses."""
    try:
        attrgetter("in_keys", attribute)(network)
    except AttributeError:
        raise ConfigError(
            f"{name} is a {type(network).__name__}, without in_keys or {attribute}: pass "
            f"{_INSTEAD[attribute]}"
        ) from None


def checked_reduction(reduction: Reduction | None) -> Reduction:
    """Return how losses are combined: as given, or "mean" for None."""
    reduction = "mean" if reduction is None else reduction
    check_choice("reduction", reduction, Reduction)
    return reduction


def _reset_parameters(module: nn.Module) -> None:
    """Reset the parameters of a module's parts, then its own."""
    for child in module.children():
        _reset_parameters(child)
    if hasattr(module, "reset_parameters"):
        module.reset_parameters()


def _not_reset(module: nn.Module) -> set[str]:
    """Return the classes of modules with parameters that no ``reset_parameters`` draws."""
    if hasattr(module, "reset_parameters"):
        return set()
    own = {type(module).__name__} if any(True for _ in module.parameters(recurse=False)) else set()
    return own.union(*map(_not_reset, module.children()))


def with_buffer_updates(updater: Updater) -> Updater:
    """Let a target updater of TorchRL move buffers as it moves parameters; return it.

    TorchRL's updaters leave out buffers, such as the statistics of a batch norm, which a target
    network in evaluation mode does not change by itself. Only floating-point buffers move, and of
    these only finite ones, not masks of infinities.

    Examples:
        >>> import torch
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import SoftUpdate
        >>> from ba_torchrl.objectives import LevelDQNLoss, with_buffer_updates
        >>> network = torch.nn.Sequential(torch.nn.BatchNorm1d(3), torch.nn.Linear(3, 2))
        >>> loss = LevelDQNLoss(QValueActor(network, action_space="categorical"))
        >>> updater = with_buffer_updates(SoftUpdate(loss, tau=0.01))
    """
    sources, targets = updater._sources.copy(), updater._targets.copy()
    for target_name in list(targets.keys()):
        name = target_name.removeprefix("target_")
        online = getattr(updater.loss_module, name)
        target = getattr(updater.loss_module, target_name)
        for key, buffer in online.items(True, True):
            if buffer.requires_grad or not buffer.is_floating_point():
                continue
            if bool(buffer.isfinite().all()):
                path = key if isinstance(key, tuple) else (key,)
                sources.set((name, *path), buffer)
                targets.set((target_name, *path), target.get(key))
    updater._sources, updater._targets = sources.lock_(), targets.lock_()
    return updater
