"""The interface of algorithms: a policy, a replay and an update, called by the experiment.

An algorithm is a `LearnerConfig`, registered under its name, and a `Learner` that it builds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.data import ReplayBuffer
from torchrl.envs import Transform
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.trainers import OptimizationStepper

from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.compilation import CompiledLoss, CompileMode
from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.host_tasks import IS_FINITE, HostTasks, check_finite
from ba_torchrl.algorithms.optimizers import LossFunction, Optimizers, Update
from ba_torchrl.algorithms.problem import Problem
from ba_torchrl.core import keys
from ba_torchrl.core.choices import Control
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.seeds import SeedUse, derive_seed
from ba_torchrl.data.replay.codecs import ImageCodecs
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.transfer import batch_to_device
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.modules.config import NETWORKS, NetworkConfig
from ba_torchrl.objectives.networks import with_buffer_updates

__all__ = [
    "ALGORITHMS",
    "NETWORKS",
    "Control",
    "Learner",
    "LearnerConfig",
    "LossFunction",
    "NetworkConfig",
    "Problem",
    "SeedUse",
    "derive_seed",
]


class Learner(ABC):
    """Networks, a loss, an optimiser and a replay, which `ba_torchrl.training.experiment` fills.

    The constructor calls the ``make_...`` methods, which get as arguments what earlier ones made;
    of the learner, they use `config`, `problem`, `images`, `vectors` and `observation_keys` alone.
    An algorithm implements the first three and can override the others.

    An update minimises the sums of the ``loss_...`` entries of its stages one after the other, by
    default that of the loss module.

    On a CUDA device the host does not wait for an update: batches are copied as uint8 codes from
    pinned memory, and priorities are set, and losses checked, at the end of the next update. From a
    loss that is not finite on, an update changes no parameter.

    Args:
        config: hyper-parameters.
        network: builds the networks.
        problem: images, actions, device, seed and length of the run.

    Raises:
        ConfigError: the environment does not observe what the network sees.
        ValueError: the network does not support the images or the actions.
    """

    policy: TensorDictModuleBase
    """From a root TensorDict of any batch shape to ``action``; explores under TorchRL's
    exploration type RANDOM and is greedy under DETERMINISTIC."""
    updates: int = 0
    """Gradient updates so far."""
    entries_per_transition: int = 1
    """Entries of the replay that its transforms make of a new transition."""

    def __init__(self, config: LearnerConfig, network: NetworkConfig, problem: Problem) -> None:
        self.config = config
        self.problem = problem
        self.images = _observed(problem.images, network.image_keys, "images")
        """Declarations of the networks' input images, which the replay stores."""
        self.vectors = _observed(problem.vectors, network.vector_keys, "vectors")
        """Lengths of the networks' input vectors, which the replay stores."""
        self.observation_keys = [*self.images, keys.HOLDING, *self.vectors]
        self.host_tasks = HostTasks(problem.device)
        networks = self.make_networks(network)
        policy = self.make_policy(networks)
        self.loss = self.make_loss(networks).to(problem.device)
        self.trained_policy = policy.to(problem.device)
        self.averaged_policy = config.optimizer.average(self.trained_policy)
        acting = self.averaged_policy.module if self.averaged_policy else self.trained_policy
        self.policy = ActingPolicy(
            acting, self.make_acting_transforms(), self.make_exploration()
        ).to(problem.device)
        self.stages = self.make_stages(self.loss)
        self.first_losses = self.make_first_losses(self.trained_policy, self.loss)
        updater = self.make_target_updater(self.loss)
        self.target_updater = None if updater is None else with_buffer_updates(updater)
        self.replay = self.make_replay()
        for transform in self.make_transforms(networks):
            self.replay.append_transform(transform)
        self.optimizer = self.make_optimizer(self.loss)
        self.stepper = self.make_stepper(self.optimizer, self.loss)

    @property
    def network_spec(self) -> ActorCriticSpec:
        """What actor-critic networks see and compute."""
        return ActorCriticSpec(
            self.seen_images,
            self.problem.actions.sequence,
            vectors=self.vectors,
            center_m=self.problem.center_m,
        )

    @property
    def seen_images(self) -> Mapping[str, ImageSpec]:
        """Declarations of the images that the networks see; by default those of the replay."""
        return self.images

    # -- parts -------------------------------------------------------------------------------

    @abstractmethod
    def make_networks(self, network: NetworkConfig) -> Any:
        """Return the freshly initialised networks, for `make_policy` and `make_loss`."""

    @abstractmethod
    def make_policy(self, networks: Any) -> TensorDictModuleBase:
        """Return the policy, from the observation to ``action``; see `policy`."""

    @abstractmethod
    def make_loss(self, networks: Any) -> LossModule:
        """Return the loss module with its value estimator."""

    def make_acting_transforms(self) -> list[Transform]:
        """Return the transforms of the observation that the acting policy sees; by default the
        images' codecs."""
        return [ImageCodecs(self.images)]

    def make_exploration(self) -> TensorDictModuleBase | None:
        """Return what changes the actions of the acting policy, called only when it explores; by
        default None, which leaves exploration to the policy's distribution."""
        return None

    def make_stages(self, loss: LossModule) -> list[LossFunction]:
        """Return the losses of an update in the order in which they are minimised, each after the
        optimisers' step on the one before; by default the loss module alone."""
        return [loss]

    def make_first_losses(
        self, policy: TensorDictModuleBase, loss: LossModule
    ) -> list[tuple[int, LossFunction]]:
        """Return numbers of first updates of a run, and the loss that each number of updates
        minimises instead of the stages; by default none."""
        return []

    def due_stages(self) -> Sequence[LossFunction]:
        """Return the stages of the update that follows `updates` others, unless a loss of
        `make_first_losses` is due; by default all. An algorithm that updates its policy less often
        than its critics leaves one out."""
        return self.stages

    def make_target_updater(self, loss: LossModule) -> TargetNetUpdater | None:
        """Return the updater of the target network, None if there is no target network."""
        return None

    def make_replay(self) -> ReplayBuffer:
        """Return the replay that the configuration names."""
        seed, size = self.problem.derived_seed(SeedUse.REPLAY), self.config.batch_size
        return self.config.replay.build(size, self.images, seed, self.problem.device)

    def make_transforms(self, networks: Any) -> list[Transform]:
        """Return the transforms of the replay, called on sampled batches and, their inverse, on new
        transitions; by default none."""
        return []

    def make_optimizer(self, loss: LossModule) -> Optimizer:
        """Return the optimiser of the loss's terms that have none of `make_term_optimizers`."""
        return self.adam(loss.parameters(), loss)

    def make_term_optimizers(self, loss: LossModule) -> Mapping[str, Mapping[str, Optimizer]]:
        """Return the optimisers of single terms of the loss, by the names of term and optimiser;
        by default none. Their terms are in a stage without others."""
        return {}

    def make_stepper(self, optimizer: Optimizer, loss: LossModule) -> OptimizationStepper:
        """Return what takes the gradient steps of an update: by default all optimisers with their
        schedules. A stepper of TorchRL takes a step of `optimizer` on the sum of all stages,
        without a schedule."""
        return Optimizers(
            optimizer,
            self.make_term_optimizers(loss),
            self.make_scheduler,
            clamp=self.config.optimizer.gradient_clamp,
            clamped=self.network_parameters(loss),
        )

    def make_scheduler(self, optimizer: Optimizer) -> LRScheduler:
        """Return the schedule of an optimiser's learning rate, which steps once per update."""
        return self.config.optimizer.schedule(optimizer, self.problem.total_updates)

    def adam(
        self, parameters: Iterable[nn.Parameter], loss: LossModule, factor: float = 1.0
    ) -> Optimizer:
        """Return Adam for some parameters of a loss; ``factor`` scales the learning rate, and only
        the parameters of networks have weight decay."""
        return self.config.optimizer.adam(parameters, self.network_parameters(loss), factor)

    def network_parameters(self, loss: LossModule) -> list[nn.Parameter]:
        """Return the parameters of a loss to which weight decay and the gradient's bound apply."""
        return list(loss.parameters())

    # -- data --------------------------------------------------------------------------------

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action that the policy can choose, for each action [..., A]; by
        default the action itself. Demonstrations execute what is learned: these actions."""
        return action

    @property
    def equal_moves(self) -> int:
        """Largest number of equal moves, any of which is imitated; by default 0, for one action."""
        return 0

    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDict:
        """Return steps of any batch shape as the transitions [N] that the replay stores."""
        return as_transitions(
            data,
            self.images,
            self.vectors,
            is_demonstration=is_demonstration,
            imitates=self.config.imitates,
            equal_moves=self.equal_moves,
        )

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Process the demonstrations, TensorDicts [T], before the first update; by default they
        enter the replay."""
        for episode in episodes:
            self.extend(self.to_transitions(episode, is_demonstration=True))

    def on_collected(self, data: TensorDictBase) -> None:
        """Process collected steps, of any batch shape; by default they enter the replay."""
        self.extend(self.to_transitions(data, is_demonstration=False))

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N], and augmented copies if configured, to the replay, except those with
        a fault."""
        new = self.entries_per_transition * len(transitions)
        if len(self.replay) + new > self.config.replay.capacity:
            self.host_tasks.run()  # before its transitions are overwritten: deferred priorities
        self.replay.extend(transitions)

    def sample(self) -> TensorDictBase:
        """Return an augmented batch from the replay on the learner's device."""
        if self._is_prioritized:
            first = self.config.first_updates
            own, total = (n - first for n in (self.updates, self.problem.total_updates))
            self.replay.sampler.anneal(max(own, 0) / max(total, 1))
        batch, device = self.replay.sample(), self.problem.device
        return batch if device.type == "cpu" else batch_to_device(batch, device)

    # -- updates -----------------------------------------------------------------------------

    def update(self) -> TensorDict:
        """Take the gradient steps on a batch, and update the target network and the priorities;
        return scalars without gradient, all on one device.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        batch = self.sample()
        first = [loss for updates, loss in self.first_losses if self.updates < updates]
        scalars = self.minimize(batch, first or self.due_stages())
        if self._is_prioritized and keys.TD_ERROR in batch:
            errors = {key: batch[key] for key in ("index", keys.TD_ERROR)}
            self.host_tasks.submit(errors, self._set_priorities)
        return scalars

    def compile(self, mode: CompileMode) -> None:
        """Compile the loss and its gradient, except those of `make_first_losses`; see
        `CompiledLoss`."""
        self.stages = [CompiledLoss(self.loss, mode, stage) for stage in self.stages]

    def _set_priorities(self, errors: dict[str, Tensor]) -> None:
        self.replay.update_tensordict_priority(TensorDict(errors, [len(errors["index"])]))

    def minimize(self, batch: TensorDictBase, stages: Sequence[LossFunction]) -> TensorDict:
        """Call `step` with these arguments, count the update, and return what `step` returns."""
        before = len(self.host_tasks)
        scalars = self.step(batch, stages)
        if self.averaged_policy is not None:
            self.averaged_policy.update_parameters(self.trained_policy)
        self.updates += 1
        self.host_tasks.run(before)
        return scalars

    def step(self, batch: TensorDictBase, stages: Sequence[LossFunction]) -> TensorDict:
        """Take the gradient steps on the sums of losses of stages of a batch, then one step of the
        target network; return the scalars of all stages, without gradient.

        Raises:
            FloatingPointError: a loss is not finite.
            ValueError: the losses of a stage have different optimisers.
        """
        clamp = self.config.optimizer.gradient_clamp
        update = Update(stages, self._check_finite, self.optimizer, clamp)
        scalars = self.stepper.step(update, batch)
        if self.target_updater is not None:
            self.target_updater.step()
        return scalars

    def _check_finite(self, scalars: TensorDictBase, is_finite: Tensor) -> Tensor | None:
        values = {**scalars, IS_FINITE: is_finite}
        self.host_tasks.submit(values, partial(check_finite, self.updates))
        return is_finite if self.host_tasks.is_deferred else None

    @property
    def _is_prioritized(self) -> bool:
        return isinstance(self.replay.sampler, ExpertPrioritizedSampler)

    # -- state -------------------------------------------------------------------------------

    def _stateful_parts(self) -> dict[str, nn.Module]:
        parts = {"loss": self.loss, "averaged_policy": self.averaged_policy}
        return {name: part for name, part in parts.items() if part is not None}

    def generators(self) -> Mapping[str, torch.Generator]:
        """Return the generators whose states are saved, by name, besides those of the replay and
        its transforms; by default none."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return networks, target, optimiser, schedule, generators and number of updates.

        Raises:
            FloatingPointError: a loss of the last update was not finite.
        """
        self.host_tasks.run()
        state = {name: part.state_dict() for name, part in self._stateful_parts().items()}
        draws = {name: each.get_state() for name, each in self.generators().items()}
        steps = {"optimizer": self.optimizer.state_dict(), **self.stepper.state_dict()}
        return {**state, **steps, "updates": self.updates, **draws}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        for name, part in self._stateful_parts().items():
            part.load_state_dict(state[name])
        self.optimizer.load_state_dict(state["optimizer"])
        self.stepper.load_state_dict(state)
        self.updates = state["updates"]
        for name, generator in self.generators().items():
            generator.set_state(state[name].cpu())

    def replay_state(self) -> dict[str, Any]:
        """Return transitions, priorities and the state of the draws, as views: do not modify them.

        Raises:
            FloatingPointError: a loss of the last update was not finite.
        """
        self.host_tasks.run()
        return self.replay.state_dict()

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Restore the replay from a `replay_state`."""
        self.replay.load_state_dict(state)


def _observed(found: Mapping[str, Any], names: Iterable[str], kind: str) -> dict[str, Any]:
    """Return what is known of the observations that a network sees; `ConfigError` if one is
    missing."""
    if missing := [name for name in names if name not in found]:
        raise ConfigError(
            f"the network sees {', '.join(missing)}; the environment observes "
            f"{', '.join(found) or f'no {kind}'}. Set 'env.observations=[{','.join(missing)}]'"
        )
    return {name: found[name] for name in names}
