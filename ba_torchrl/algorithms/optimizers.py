"""Optimisers of the terms of a loss, as a stepper of TorchRL's trainers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.trainers import OptimizationStepper, Trainer

LossFunction = Callable[[TensorDictBase], TensorDictBase]
"""Losses, whose names begin with ``loss_``, and diagnostics of a batch."""


def loss_terms(scalars: TensorDictBase) -> dict[str, Tensor]:
    """Return the losses among the results of a loss function, without the diagnostics."""
    return {name: value for name, value in scalars.items() if name.startswith("loss_")}


@dataclass
class Update:
    """An update of a learner, which a stepper takes in the place of a trainer.

    The attributes besides `stages` and `check` are those that TorchRL's steppers read.
    """

    stages: Sequence[LossFunction]
    """Losses in the order in which `Optimizers` minimises them. TorchRL's steppers minimise the sum
    of all."""
    check: Callable[[TensorDictBase, Tensor], Tensor | None]
    """Called with the results of each stage, and whether all losses so far are finite; returns the
    condition of `Optimizers.minimize`."""
    optimizer: Optimizer
    clip_norm: float | None
    clip_grad_norm: bool = False
    """False: `clip_norm` bounds each element of the gradient."""

    def compute_loss(self, batch: TensorDictBase) -> TensorDict:
        """Return the results of all stages."""
        scalars = TensorDict()
        for stage in self.stages:
            scalars.update(stage(batch))
        self.check(scalars, torch.isfinite(sum(loss_terms(scalars).values())))
        return scalars


class Optimizers(OptimizationStepper):
    """The optimisers of a learner and the schedules of their learning rates.

    A trainer of TorchRL takes them as its ``optimization_stepper``.

    Args:
        main: of all terms of the loss that have no optimiser of their own.
        of_terms: the other optimisers: by the name of a term, those that minimise it, by name. A
            parameter can be in several optimisers, each of which has moments of its own.
        make_scheduler: returns the schedule of an optimiser's learning rate.
        clamp: bound of each element of some gradients; None for no bound.
        clamped: their parameters.
    """

    def __init__(
        self,
        main: Optimizer,
        of_terms: Mapping[str, Mapping[str, Optimizer]],
        make_scheduler: Callable[[Optimizer], LRScheduler],
        *,
        clamp: float | None = None,
        clamped: Collection[nn.Parameter] = (),
    ) -> None:
        self._main = main
        self._of_terms = of_terms
        self._clamp, self._clamped = clamp, clamped
        self._stepped: set[Optimizer] = set()
        self._named = {"": main}
        for optimizers in of_terms.values():
            for name, optimizer in optimizers.items():
                if self._named.setdefault(f"{name}_", optimizer) is not optimizer:
                    raise ValueError(f"two optimisers have the name {name!r}")
        self.schedulers = {name: make_scheduler(each) for name, each in self._named.items()}

    def step(self, trainer: Update | Trainer, sub_batch: TensorDictBase) -> TensorDict:
        """Take a gradient step per stage, on the sum of its losses, then step the schedules.

        Args:
            trainer: computes the losses; those of TorchRL's trainer are a single stage. A stage is
                computed after the step on the one before.
            sub_batch: of transitions.

        Returns:
            The results of all stages, without gradient.
        """
        is_update = isinstance(trainer, Update)
        taken, is_finite, condition = TensorDict(), True, None
        for stage in trainer.stages if is_update else [trainer.compute_loss]:
            scalars = stage(sub_batch)
            terms = loss_terms(scalars)
            loss = sum(terms.values())
            if is_update:
                is_finite = is_finite & torch.isfinite(loss)
                condition = trainer.check(scalars, is_finite)
            self.minimize(loss, terms, condition)
            taken.update(scalars.detach())
        self.step_schedules()
        return taken

    def of(self, terms: Collection[str]) -> list[Optimizer]:
        """Return the optimisers that minimise a sum of terms; `ValueError` if the terms have
        different ones."""
        own = [list(self._of_terms[term].values()) for term in terms if term in self._of_terms]
        if not own:
            return [self._main]
        if len(own) < len(terms) or any(each != own[0] for each in own):
            raise ValueError(
                f"the terms {', '.join(terms)} have different optimisers; minimise them one after "
                "the other"
            )
        return own[0]

    def minimize(
        self, loss: Tensor, terms: Collection[str], condition: Tensor | None = None
    ) -> None:
        """Take one step of each optimiser of a sum of terms, along the gradient of this sum.

        Args:
            loss: the sum.
            terms: names of the terms.
            condition: bool scalar on the parameters' device, False for a step that changes nothing;
                None for True.
        """
        optimizers = self.of(terms)
        for optimizer in optimizers:
            if condition is not None:
                optimizer.found_inf = (~condition).float()  # as a GradScaler does
            optimizer.zero_grad()
        loss.backward()
        if self._clamp is not None:
            groups = [group for each in optimizers for group in each.param_groups]
            stepped = {id(p) for group in groups for p in group["params"]}
            clamped = [p for p in self._clamped if id(p) in stepped]
            nn.utils.clip_grad_value_(clamped, self._clamp)
        for optimizer in optimizers:
            optimizer.step()
        self._stepped.update(optimizers)

    def step_schedules(self) -> None:
        """Take one step of every learning rate."""
        for name, scheduler in self.schedulers.items():
            optimizer = self._named[name]
            if optimizer not in self._stepped:  # torch warns of a schedule without steps
                optimizer.zero_grad()
                optimizer.step()  # without a gradient: changes nothing
                self._stepped.add(optimizer)
            scheduler.step()

    def state_dict(self) -> dict[str, Any]:
        """Return the states of optimisers and schedules, by name."""
        return {
            **{f"{name}optimizer": each.state_dict() for name, each in self._named.items()},
            **{f"{name}scheduler": each.state_dict() for name, each in self.schedulers.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the states from those of a `state_dict` of any device."""
        for name, optimizer in self._named.items():
            optimizer.load_state_dict(state[f"{name}optimizer"])
            self.schedulers[name].load_state_dict(state[f"{name}scheduler"])
