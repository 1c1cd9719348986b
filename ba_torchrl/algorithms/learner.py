"""Learner: gradient steps on batches from a replay, with parts that algorithms override."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LinearLR, LRScheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.base import ALGORITHMS, Algorithm, NetworkConfig, Problem
from ba_torchrl.algorithms.compilation import CompiledLoss, CompileMode
from ba_torchrl.algorithms.host_tasks import IS_FINITE, HostTasks, check_finite
from ba_torchrl.algorithms.learner_config import LearnerConfig
from ba_torchrl.algorithms.optimizers import Optimizers, make_adam
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.transfer import batch_to_device, decoded_on_device, to_device
from ba_torchrl.data.transitions import WITH_TARGET, as_transitions
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.objectives.imitation import BehaviourCloningLoss

LossFunction = Callable[[TensorDictBase], TensorDictBase]
"""Losses, whose names begin with "loss_", and diagnostics of a batch."""


class Learner(Algorithm):
    """Networks, a loss, an optimiser and a replay.

    The constructor calls the ``make_...`` methods. An algorithm implements the first three and can
    override the others. An update minimises the sums of the
    ``loss_...`` entries of its stages one after the other, by default that of the loss module.

    On a CUDA device the host does not wait for an update: batches are copied as uint8 codes from
    pinned memory, and priorities are set, and losses checked, at the end of the next update. From a
    loss that is not finite on, an update changes no parameter.

    Args:
        config: hyper-parameters.
        network: builds the networks.
        problem: images, actions, device, seed and length of the run.

    Raises:
        ConfigError: the environment does not observe an image that the network needs.
        ValueError: the network does not support the images or the actions.
    """

    def __init__(self, config: LearnerConfig, network: NetworkConfig, problem: Problem) -> None:
        self.config = config
        self.problem = problem
        missing = [key for key in network.image_keys if key not in problem.images]
        if missing:
            raise ConfigError(
                f"the network sees {', '.join(missing)}; the environment observes "
                f"{', '.join(problem.images) or 'no images'}"
            )
        self.images = {key: problem.images[key] for key in network.image_keys}
        """Declarations of the networks' input images, which the replay stores."""
        self.observation_keys = [*self.images, keys.HOLDING]
        self.codecs = make_codecs(self.images)
        self.host_tasks = HostTasks(problem.device)
        networks = self.make_networks(network)
        policy = self.make_policy(networks)
        self.loss = self.make_loss(networks).to(problem.device)
        self.trained_policy = policy.to(problem.device)
        self.averaged_policy = averaged = self.make_averaged_policy()
        acting = self.trained_policy if averaged is None else averaged.module
        self.policy = ActingPolicy(
            acting, self.make_acting_transforms(), self.make_exploration()
        ).to(problem.device)
        self.stages = self.make_stages()
        self.init_loss = self.make_init_loss() if config.init == "bc" else None
        self.target_updater = self.make_target_updater()
        self.replay = self.make_replay()
        self.stored_augmentation = self.make_stored_augmentation()
        self.augmentation = self.make_augmentation()
        self.optimizer = self.make_optimizer()
        self.optimizers = Optimizers(
            self.optimizer,
            self.make_term_optimizers(),
            self.make_scheduler,
            clamp=config.gradient_clamp,
            clamped=self.network_parameters(),
        )

    # -- parts -------------------------------------------------------------------------------

    @abstractmethod
    def make_networks(self, network: NetworkConfig) -> Any:
        """Return the freshly initialised networks, for `make_policy` and `make_loss`."""

    @abstractmethod
    def make_policy(self, networks: Any) -> TensorDictModuleBase:
        """Return the policy, from the observation to ``action``; see `Algorithm.policy`."""

    @abstractmethod
    def make_loss(self, networks: Any) -> LossModule:
        """Return the loss module with its value estimator."""

    def make_averaged_policy(self) -> AveragedModel | None:
        """Return the moving average of the policy that acts; None if the policy itself acts."""
        if not self.config.policy_average:
            return None
        average = get_ema_multi_avg_fn(self.config.policy_average)
        return AveragedModel(self.trained_policy, multi_avg_fn=average)

    def make_init_loss(self) -> LossModule:
        """Return the loss of the pretraining updates with ``init="bc"``.

        Raises:
            ConfigError: the policy is not a distribution of actions.
        """
        policy = self.trained_policy
        if not isinstance(policy, ProbabilisticTensorDictSequential):
            name = ALGORITHMS.name_of(type(self.config))
            raise ConfigError(f"init: algorithm {name!r} has no actor for cloning to initialise")
        loss = BehaviourCloningLoss(policy, "kl", self.config.init_entropy_weight)
        loss.set_keys(action=keys.TARGET_ACTION)
        return loss

    def make_acting_transforms(self) -> Mapping[str, nn.Module]:
        """Return the transform of each image that the acting policy sees; by default its codec."""
        return self.codecs

    def make_exploration(self) -> TensorDictModuleBase | None:
        """Return what changes the actions of the acting policy, called only when it explores; by
        default None, which leaves exploration to the policy's distribution."""
        return None

    def make_stages(self) -> list[LossFunction]:
        """Return the losses of an update in the order in which they are minimised, each after the
        optimisers' step on the one before; by default the loss module alone."""
        return [self.loss]

    def make_target_updater(self) -> TargetNetUpdater | None:
        """Return the updater of the target network, None if there is no target network."""
        return None

    def make_replay(self) -> ReplayBuffer:
        """Return the replay that the configuration names."""
        config = self.config
        return make_replay(
            config.replay,
            config.buffer_size,
            config.batch_size,
            codecs=self.codecs,
            seed=self.problem.derived_seed(SeedUse.REPLAY),
            priority_exponent=config.priority_exponent,
            weight_exponent=config.importance_exponent,
            expert_bonus=config.expert_bonus,
            returns_codes=self.problem.device.type != "cpu",
        )

    def make_stored_augmentation(self) -> nn.Module:
        """Return the map from new transitions [N] to those that are stored; by default the
        identity."""
        return nn.Identity()

    def make_augmentation(self) -> nn.Module:
        """Return the augmentation of sampled batches; by default the identity."""
        return nn.Identity()

    def make_optimizer(self) -> Optimizer:
        """Return the optimiser of all terms of the loss but those of `make_term_optimizers`."""
        return self.adam(self.loss.parameters())

    def make_term_optimizers(self) -> Mapping[str, Mapping[str, Optimizer]]:
        """Return the optimisers of single terms of the loss, by the names of term and optimiser;
        by default none. Their terms are in a stage without others."""
        return {}

    def make_scheduler(self, optimizer: Optimizer) -> LRScheduler:
        """Return the schedule of an optimiser's learning rate, which steps once per update."""
        end, updates = self.config.learning_rate_end_factor, self.problem.total_updates
        return LinearLR(optimizer, start_factor=1.0, end_factor=end, total_iters=updates)

    def adam(self, parameters: Iterable[nn.Parameter], factor: float = 1.0) -> Optimizer:
        """Return Adam for some parameters with a factor on the learning rate, and with weight decay
        on those of the networks only."""
        config, decayed = self.config, self.network_parameters()
        return make_adam(parameters, decayed, factor * config.learning_rate, config.weight_decay)

    def network_parameters(self) -> list[nn.Parameter]:
        """Return the parameters to which weight decay and the gradient's bound apply."""
        return list(self.loss.parameters())

    # -- data --------------------------------------------------------------------------------

    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDict:
        """Return collected data as the transitions [N] that the replay stores.

        Raises:
            KeyError: an entry is missing.
        """
        return as_transitions(
            data, self.images, is_demonstration=is_demonstration, imitates=self.config.imitates
        )

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N], and augmented copies if configured, to the replay, except those with
        a fault."""
        stored = self.stored_augmentation(transitions)
        if len(self.replay) + len(stored) > self.config.buffer_size:
            self.host_tasks.run()  # before its transitions are overwritten: deferred priorities
        self.replay.extend(stored)

    @property
    def replay_size(self) -> int:
        """Number of transitions in the replay."""
        return len(self.replay)

    def sample(self, *, demonstrations_only: bool = False) -> TensorDictBase:
        """Return an augmented batch from the replay, on the learner's device.

        Args:
            demonstrations_only: leave out the batch's other transitions.
        """
        sampler = self._prioritized_sampler()
        if sampler is not None:
            sampler.anneal(self._annealing_progress())
        batch, device = self.replay.sample(), self.problem.device
        rows = (
            batch[keys.IS_DEMONSTRATION].reshape(-1).nonzero()[:, 0]
            if demonstrations_only
            else None
        )
        if device.type == "cpu":
            batch = self.augmentation(batch)
        else:
            batch = decoded_on_device(batch, self.codecs, device)
            batch = batch_to_device(self.augmentation(batch), device)
        return batch if rows is None else batch[to_device(rows, device)]

    # -- updates -----------------------------------------------------------------------------

    def update(self) -> TensorDict:
        """Take the gradient steps on a batch, and update the target network and the priorities.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        batch = self.sample()
        scalars = self.minimize(stage(batch) for stage in self.stages)
        if self._prioritized_sampler() is not None:  # whose trees are on the CPU
            errors = {key: batch[key] for key in ("index", keys.TD_ERROR)}
            self.host_tasks.submit(errors, self._set_priorities)
        return scalars

    def compile(self, mode: CompileMode) -> None:
        """As for `Algorithm`: the loss and its gradient, except those of ``pretraining_option``."""
        if not self.config.is_compilable:
            super().compile(mode)
        self.stages = [CompiledLoss(self.loss, mode, stage) for stage in self.stages]

    def own_updates(self, updates: int) -> int:
        """Return how many of the first updates of a run minimise the algorithm's own loss."""
        is_own = self.config.pretraining_option is None
        return updates if is_own else max(updates - self.problem.pretrain_updates, 0)

    def _annealing_progress(self) -> float:
        total = self.own_updates(self.problem.total_updates)
        return self.own_updates(self.updates) / max(total, 1)

    def _set_priorities(self, errors: dict[str, Tensor]) -> None:
        self.replay.update_tensordict_priority(TensorDict(errors, [len(errors["index"])]))

    def pretrain_update(self) -> TensorDict:
        """Take one update before the first collection; with ``init="bc"``, of behaviour cloning of
        the expert's transitions in a batch.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        if self.init_loss is None:
            return self.update()
        return self.minimize([self.init_loss(self.sample(demonstrations_only=True))])

    def minimize(self, stages: Iterable[TensorDictBase]) -> TensorDict:
        """Take the steps of `step`, update the average, and count the update; see there for
        argument, result and errors."""
        before = len(self.host_tasks)
        scalars = self.step(stages)
        if self.averaged_policy is not None:
            self.averaged_policy.update_parameters(self.trained_policy)
        self.updates += 1
        self.host_tasks.run(before)
        return scalars

    def step(self, stages: Iterable[TensorDictBase]) -> TensorDict:
        """Take a gradient step on each of several sums of losses, then one step of schedules and
        target network.

        Args:
            stages: losses, whose names begin with "loss_", and diagnostics. An iterator computes
                each stage after the step on the one before.

        Returns:
            The scalars of all stages, without gradient.

        Raises:
            FloatingPointError: a loss is not finite.
            ValueError: the losses of a stage have different optimisers.
        """
        if isinstance(stages, TensorDictBase):
            raise TypeError("a list of stages is needed, for example [self.loss(batch)]")
        taken, is_finite, is_deferred = TensorDict(), True, self.host_tasks.is_deferred
        for scalars in stages:
            terms = {name: value for name, value in scalars.items() if name.startswith("loss_")}
            loss = sum(terms.values())
            is_finite = is_finite & torch.isfinite(loss)
            values = {**scalars, IS_FINITE: is_finite}
            self.host_tasks.submit(values, partial(check_finite, self.updates))
            self.optimizers.minimize(loss, terms, is_finite if is_deferred else None)
            taken.update(scalars.detach())
        self.optimizers.step_schedules()
        if self.target_updater is not None:
            self.target_updater.step()
        return taken

    def _prioritized_sampler(self) -> ExpertPrioritizedSampler | None:
        sampler = self.replay.sampler
        return sampler if isinstance(sampler, ExpertPrioritizedSampler) else None

    # -- state -------------------------------------------------------------------------------

    def _stateful_parts(self) -> dict[str, Any]:
        names = ["loss", "stored_augmentation", "augmentation"]
        if self.averaged_policy is not None:
            names.append("averaged_policy")
        return {name: getattr(self, name) for name in names}

    def state_dict(self) -> dict[str, Any]:
        """Return networks, target, optimiser, schedule, augmentations and number of updates.

        Raises:
            FloatingPointError: a loss of the last update was not finite.
        """
        self.host_tasks.run()
        state = {name: part.state_dict() for name, part in self._stateful_parts().items()}
        return {**state, **self.optimizers.state_dict(), "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        for name, part in self._stateful_parts().items():
            part.load_state_dict(state[name])
        self.optimizers.load_state_dict(state)
        self.updates = state["updates"]

    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws.

        Raises:
            FloatingPointError: a loss of the last update was not finite.
        """
        self.host_tasks.run()
        self.replay.dumps(folder)

    def load_replay(self, folder: Path) -> None:
        """Restore the replay from a folder that `save_replay` wrote.

        Raises:
            ConfigError: its transitions have other entries than those of this learner.
        """
        self.replay.loads(folder)
        has_target = self.config.imitates in WITH_TARGET
        expected = {keys.IS_DEMONSTRATION: True, keys.TARGET_ACTION: has_target}
        for key, is_expected in expected.items():
            if len(self.replay) and (key in self.replay.stored_keys) != is_expected:
                raise ConfigError(
                    f"the saved transitions {'lack' if is_expected else 'have'} the entry {key!r}: "
                    "another version of the library wrote them; start the run again in another "
                    "run_dir"
                )
