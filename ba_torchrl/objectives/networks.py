"""The networks of losses: in which mode they compute, and how the buffers of targets move."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from ba_torchrl.core.evaluation_mode import evaluation_copy

Updater = TypeVar("Updater", bound=TargetNetUpdater)


class ModalLoss(LossModule):
    """A loss whose networks compute in evaluation mode where there is no gradient.

    They do so for targets, and for the whole loss under `torch.no_grad`. Elsewhere they are in the
    mode in which they were given, usually training mode.
    """

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
