"""Learner: gradient steps on batches from a replay, with parts that algorithms override."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
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
from ba_torchrl.algorithms.optimizer_state import fits
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.transfer import batch_to_device, decoded_on_device, to_device
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.objectives.imitation import BehaviourCloningLoss

logger = logging.getLogger(__name__)


class Learner(Algorithm):
    """Networks, a loss, an optimiser and a replay.

    The constructor calls the ``make_...`` methods in the order of their definition. An algorithm
    implements the first three and can override the others. An update minimises the sum of the
    ``loss_...`` entries of the loss module.

    On a CUDA device the host does not wait for an update: batches are copied as uint8 codes from
    pinned memory, and priorities are set, and losses checked, at the end of the next update. An
    update with a loss that is not finite changes no parameter.

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
        self.compute_losses: Callable[[TensorDictBase], TensorDictBase] = self.loss
        self.init_loss = self.make_init_loss() if config.init == "bc" else None
        self.target_updater = self.make_target_updater()
        self.replay = self.make_replay()
        self.stored_augmentation = self.make_stored_augmentation()
        self.augmentation = self.make_augmentation()
        self.optimizer = self.make_optimizer()
        self.scheduler = self.make_scheduler()

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
            raise ConfigError(
                f"init: algorithm {ALGORITHMS.name_of(type(self.config))!r} has no actor that "
                "behaviour cloning could initialise"
            )
        loss = BehaviourCloningLoss(policy, "kl", self.config.init_entropy_weight)
        loss.set_keys(action=keys.EXPERT_ACTION if self.has_expert_action else keys.ACTION)
        return loss

    def make_acting_transforms(self) -> Mapping[str, nn.Module]:
        """Return the transform of each image that the acting policy sees; by default its codec."""
        return self.codecs

    def make_exploration(self) -> TensorDictModuleBase | None:
        """Return what changes the actions of the acting policy, called only when it explores; by
        default None, which leaves exploration to the policy's distribution."""
        return None

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

    def make_optimizer(self) -> torch.optim.Optimizer:
        """Return Adam, with weight decay on the parameters of the networks only."""
        networks = self.network_parameters()
        known = set(map(id, networks))
        others = [p for p in self.loss.parameters() if id(p) not in known]
        groups = [
            {"params": networks, "weight_decay": self.config.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        return torch.optim.Adam(
            [group for group in groups if group["params"]],
            lr=self.config.learning_rate,
            fused=True,
        )

    def make_scheduler(self) -> LRScheduler:
        """Return the schedule of the learning rate, which steps once per update."""
        return LinearLR(
            self.optimizer,
            start_factor=1.0,
            end_factor=self.config.learning_rate_end_factor,
            total_iters=self.problem.total_updates,
        )

    def network_parameters(self) -> list[nn.Parameter]:
        """Return the parameters to which weight decay and the gradient's bound apply."""
        return list(self.loss.parameters())

    # -- data --------------------------------------------------------------------------------

    @property
    def imitates_demonstrations(self) -> bool:
        """Whether a term of the loss is for transitions with ``is_expert`` only, by default True.
        Without such a term, random actions of demonstrations count as demonstrations too."""
        return True

    @property
    def has_expert_action(self) -> bool:
        """Whether stored transitions have ``expert_action``, the action that is imitated, beside
        the executed one; by default if it is collected, and with ``init="bc"``."""
        return self.collects_expert_action or self.config.init == "bc"

    def to_transitions(self, data: TensorDictBase, *, is_expert: bool) -> TensorDict:
        """Return collected data as the transitions [N] that the replay stores.

        Raises:
            KeyError: an entry is missing.
        """
        label = None
        if self.has_expert_action:
            is_labelled = self.collects_expert_action and not is_expert
            is_labelled |= keys.EXPERT_ACTION in data
            label = keys.EXPERT_ACTION if is_labelled else keys.ACTION
        if is_expert and not self.imitates_demonstrations:
            data = data.exclude(keys.IS_EXPERT)
        return as_transitions(data, self.images, is_expert=is_expert, label=label)

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
        rows = batch[keys.IS_EXPERT].reshape(-1).nonzero()[:, 0] if demonstrations_only else None
        if device.type == "cpu":
            batch = self.augmentation(batch)
        else:
            batch = decoded_on_device(batch, self.codecs, device)
            batch = batch_to_device(self.augmentation(batch), device)
        return batch if rows is None else batch[to_device(rows, device)]

    # -- updates -----------------------------------------------------------------------------

    def update(self) -> TensorDict:
        """Take one gradient step on a batch, and update the target network and the priorities.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        batch = self.sample()
        scalars = self.minimize(self.compute_losses(batch))
        if self._prioritized_sampler() is not None:  # whose trees are on the CPU
            errors = {key: batch[key] for key in ("index", keys.TD_ERROR)}
            self.host_tasks.submit(errors, self._set_priorities)
        return scalars

    def compile(self, mode: CompileMode) -> None:
        """As for `Algorithm`: the loss and its gradient, except those of ``pretraining_option``."""
        if not self.config.is_compilable:
            super().compile(mode)
        self.compute_losses = CompiledLoss(self.loss, mode)

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
        return self.minimize(self.init_loss(self.sample(demonstrations_only=True)))

    def minimize(self, scalars: TensorDictBase) -> TensorDict:
        """Take one gradient step on a sum of losses, update target and average, and count it.

        Args:
            scalars: losses, whose names begin with "loss_", and diagnostics.

        Returns:
            The scalars without gradient.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        before = len(self.host_tasks)
        self.step(scalars)
        if self.averaged_policy is not None:
            self.averaged_policy.update_parameters(self.trained_policy)
        self.updates += 1
        self.host_tasks.run(before)
        return scalars.detach()

    def step(self, scalars: TensorDictBase) -> None:
        """Take one step of optimiser, schedule and target network.

        Args:
            scalars: losses, whose names begin with "loss_", and diagnostics.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        loss = sum(value for name, value in scalars.items() if name.startswith("loss_"))
        is_finite = torch.isfinite(loss)
        self.host_tasks.submit(
            {**scalars, IS_FINITE: is_finite}, partial(check_finite, self.updates)
        )
        if self.host_tasks.is_deferred:
            self.optimizer.found_inf = (~is_finite).float()  # skips the step, as a GradScaler does
        self.optimizer.zero_grad()
        loss.backward()
        if self.config.gradient_clamp is not None:
            nn.utils.clip_grad_value_(self.network_parameters(), self.config.gradient_clamp)
        self.optimizer.step()
        self.scheduler.step()
        if self.target_updater is not None:
            self.target_updater.step()

    def _prioritized_sampler(self) -> ExpertPrioritizedSampler | None:
        sampler = self.replay.sampler
        return sampler if isinstance(sampler, ExpertPrioritizedSampler) else None

    # -- state -------------------------------------------------------------------------------

    def _stateful_parts(self) -> dict[str, Any]:
        names = ["loss", "optimizer", "scheduler", "stored_augmentation", "augmentation"]
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
        return {**state, "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        for name, part in self._stateful_parts().items():
            if isinstance(part, torch.optim.Optimizer) and not fits(part, state[name]):
                logger.warning("%s: moments of another version; they are not restored", name)
                continue
            part.load_state_dict(state[name])
        rates = self.scheduler.get_last_lr()  # the optimiser's, unless its state was left out
        for group, rate in zip(self.optimizer.param_groups, rates, strict=False):
            group["lr"] = rate
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
        is_stored = keys.EXPERT_ACTION in self.replay.stored_keys
        if len(self.replay) and is_stored != self.has_expert_action:
            raise ConfigError(
                f"the saved transitions {'have' if is_stored else 'lack'} the entry "
                f"{keys.EXPERT_ACTION!r}: another version of the library wrote them; start the run "
                "again in another run_dir"
            )
