"""The interface of algorithms: a policy, a replay and an update, called by the experiment.

An algorithm is a `LearnerConfig`, registered under its name, and a `Learner` that it builds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LinearLR, LRScheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import ReplayBuffer
from torchrl.envs import Transform
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.trainers import OptimizationStepper
from typing_extensions import Self

from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.compilation import CompiledLoss, CompileMode
from ba_torchrl.algorithms.host_tasks import IS_FINITE, HostTasks, check_finite
from ba_torchrl.algorithms.optimizers import LossFunction, Optimizers, Update
from ba_torchrl.core import keys
from ba_torchrl.core.actions import CloseLoopActions, OpenLoopActions
from ba_torchrl.core.config import StrictModel, changed
from ba_torchrl.core.errors import ConfigError, PartError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.registry import Registry
from ba_torchrl.data.replay.codecs import ImageCodecs, make_codecs
from ba_torchrl.data.replay.make import ReplayKind, make_replay
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.transfer import batch_to_device, to_device
from ba_torchrl.data.transitions import WITH_TARGET, Imitation, as_transitions
from ba_torchrl.modules.base import NETWORKS, ActorCriticSpec, Control, NetworkConfig
from ba_torchrl.modules.layers import compute_dtype
from ba_torchrl.objectives.base import WeightedTerms, WeightNorm
from ba_torchrl.objectives.imitation import BehaviourCloningLoss

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
    "network_dtype",
]

ALGORITHMS: Registry[type[LearnerConfig]] = Registry("algorithm", "ba_torchrl.algorithms")


class SeedUse(IntEnum):
    """Uses of randomness in a run.

    Initial weights and the actions that SAC samples are drawn from torch's global generator, which
    is seeded with the seed of the run. Tests have seeds of their own; see
    `ba_torchrl.training.protocol`.
    """

    DEMONSTRATIONS = 0
    COLLECTION = 1
    EVALUATION = 2
    REPLAY = 5
    AUGMENTATION = 6
    EXPLORATION = 7
    VIEWS = 8
    """Random views of sampled images."""
    STORED_AUGMENTATION = 9
    """Augmented copies that are stored with each transition."""
    ENSEMBLE = 10
    """Subsets of an ensemble of critics."""
    MIXTURE = 11
    """Choice between the actions of policy and expert."""


def derive_seed(seed: int, use: SeedUse, part: int = 0) -> int:
    """Return the seed of one use of randomness in the run with a seed, or of one of its parts."""
    return int(np.random.SeedSequence([seed, use, part]).generate_state(1)[0])


@dataclass(frozen=True)
class Problem:
    """Description of the environments and the run for which an algorithm is built."""

    control: Control
    """Control of the task."""
    images: Mapping[str, ImageSpec]
    """Declarations of the images that the environment observes, by key."""
    actions: CloseLoopActions | OpenLoopActions
    """The action vector."""
    total_updates: int
    """Gradient updates of the run, the length of schedules."""
    seed: int
    device: torch.device
    vectors: Mapping[str, int] = field(default_factory=dict)
    """Length of each vector that the environment observes, by key."""
    center_m: tuple[float, float] = (0.0, 0.0)
    """x and y of the workspace's centre."""
    pretrain_updates: int = 0
    """The first of `total_updates`, before the first collection."""

    def derived_seed(self, use: SeedUse) -> int:
        """Return the run's seed for one use of randomness."""
        return derive_seed(self.seed, use)


def network_dtype(network: NetworkConfig, device: torch.device) -> torch.dtype:
    """Return the number format of a network's convolutions on a device; float32 for a network
    without the field ``precision``."""
    return compute_dtype(getattr(network, "precision", "float32"), device)


_OF_PRIORITIES = (
    "priority_exponent",
    "importance_exponent",
    "importance_weighted",
    "importance_norm",
    "expert_bonus",
)
"""Fields of a prioritised replay."""


class LearnerConfig(StrictModel, ABC):
    """Hyper-parameters of an algorithm, from which it is built for a network and a problem.

    Learning rate, batch, capacity, exponents and bonus are those of appendix G.2. Each other field
    says where its default is from.
    """

    controls: ClassVar[frozenset[Control]]
    """Controls of the tasks that the algorithm supports."""
    collects: ClassVar[bool] = True
    """Whether the policy collects transitions; if not, all updates are on the demonstrations."""
    is_compilable: ClassVar[bool] = True
    """Whether `Learner.compile` is possible."""

    learning_rate: float = Field(default=1e-3, gt=0, le=1e3)
    """Learning rate of Adam."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Final fraction of the learning rate, which decreases linearly over the run; constant in the
    reference implementation."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Adam's L2 term on the networks' parameters; none in the reference implementation's SAC."""
    gradient_clamp: float | None = Field(default=None, gt=0)
    """Bound of each element of the networks' gradient; None for no bound, as in the reference
    implementation's SAC."""
    policy_average: float = Field(default=0.0, ge=0, lt=1)
    """Decay of the exponential moving average of the policy's parameters with which the policy
    acts; 0 for acting with the last parameters. None in the appendix."""
    batch_size: int = Field(default=64, ge=1)
    """Transitions per update."""
    replay: ReplayKind = "uniform"
    """Sampling of transitions: "uniform", "prioritized" or "symmetric"."""
    buffer_size: int = Field(default=100_000, ge=1)
    """Transitions in the replay, demonstrations and others together."""
    priority_exponent: float = Field(default=0.6, ge=0)
    """Exponent alpha of the priorities of a prioritised replay."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """Initial exponent beta of the importance weights, which increases to 1 over the run; with 0,
    the weights are 1 throughout."""
    importance_weighted: WeightedTerms = "critic_and_policy"
    """Terms of the loss that the importance weights multiply: "none", "critic",
    "critic_and_policy", or "all", which adds those on demonstrations and the temperature. The
    appendix does not say; the reference implementation computes weights and does not use them."""
    importance_norm: WeightNorm = "max"
    """Statistic of a batch by which its importance weights are divided: "max", as in Schaul et al.
    (2016), or "mean", for the weighted mean of TorchRL's losses."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""
    init: Literal["random", "bc"] = "random"
    """Initialisation of the policy: "random" weights, or "bc", for which the run's pretraining
    updates are behaviour cloning of the demonstrations instead of updates of the algorithm. Critics
    are not trained meanwhile: without a behaviour term, SAC then unlearns the policy."""

    @model_validator(mode="after")
    def _check_halves(self) -> Self:
        if self.replay == "symmetric" and self.batch_size < 2:
            raise ValueError("batch_size must be at least 2 with a symmetric replay, half of each")
        return self

    @property
    def imitates(self) -> Imitation:
        """Which action the loss imitates, and on which transitions; by default the executed action
        of demonstrations, and with ``init="bc"`` the expert's."""
        return "expert" if self.init == "bc" else "executed"

    @property
    def init_entropy_weight(self) -> float:
        """Weight of the policy's negative entropy in the updates of behaviour cloning of
        ``init="bc"``."""
        return 0.0

    @property
    def pretraining_option(self) -> str | None:
        """The option and its value that only affect updates before the first collection, which
        the run must then have; None if there is none."""
        return "init: 'bc'" if self.init == "bc" else None

    def check(self, network: NetworkConfig, control: Control) -> None:
        """Check that the algorithm supports the task's control, and that the network does.

        Raises:
            ConfigError: the algorithm or the network does not support this control.
        """
        if control not in self.controls:
            known = [name for name in ALGORITHMS if control in ALGORITHMS[name].controls]
            why = f"learns {' and '.join(sorted(self.controls))} tasks, not {control} ones"
            name = ALGORITHMS.name_of(type(self))
            raise PartError("algorithm", name, why, known, f"{control} tasks")
        if network.control != control:
            known = [name for name in NETWORKS if NETWORKS[name].control == control]
            why, name = f"is for {network.control} tasks", NETWORKS.name_of(type(network))
            raise PartError("network", name, why, known, f"{control} tasks")

    def without_effect(self, network: NetworkConfig) -> Iterator[str]:
        """Yield a message for each value that has no effect together with the others and the
        network; by default, for fields of another replay."""
        if self.replay != "prioritized":
            yield from changed(self, _OF_PRIORITIES, "without replay='prioritized'")
        elif self.importance_weighted == "none":
            yield from changed(self, ["importance_norm"], "with importance_weighted='none'")

    @abstractmethod
    def build(self, network: NetworkConfig, problem: Problem) -> Learner:
        """Return a freshly initialised algorithm."""


class Learner(ABC):
    """Networks, a loss, an optimiser and a replay, which `ba_torchrl.training.experiment` fills.

    The constructor calls the ``make_...`` methods. An algorithm implements the first three and can
    override the others. An update minimises the sums of the ``loss_...`` entries of its stages one
    after the other, by default that of the loss module.

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
        missing = [key for key in network.image_keys if key not in problem.images]
        if missing:
            raise ConfigError(
                f"the network sees {', '.join(missing)}; the environment observes "
                f"{', '.join(problem.images) or 'no images'}"
            )
        self.images = {key: problem.images[key] for key in network.image_keys}
        """Declarations of the networks' input images, which the replay stores."""
        if missing := [key for key in network.vector_keys if key not in problem.vectors]:
            raise ConfigError(
                f"network.vector_keys: the environment does not observe {', '.join(missing)}; it "
                f"observes {', '.join(problem.vectors) or 'no vectors'}. env.observations adds some"
            )
        self.vectors = {key: problem.vectors[key] for key in network.vector_keys}
        """Lengths of the networks' input vectors, which the replay stores."""
        self.observation_keys = [*self.images, keys.HOLDING, *self.vectors]
        self.codecs = make_codecs(self.images)
        self.host_tasks = HostTasks(problem.device)
        networks = self.make_networks(network)
        policy = self.make_policy(networks)
        self.loss = self.make_loss(networks).to(problem.device)
        self.trained_policy = policy.to(problem.device)
        self.averaged_policy = None
        if config.policy_average:
            average = get_ema_multi_avg_fn(config.policy_average)
            self.averaged_policy = AveragedModel(self.trained_policy, multi_avg_fn=average)
        acting = self.averaged_policy.module if self.averaged_policy else self.trained_policy
        self.policy = ActingPolicy(
            acting, self.make_acting_transforms(), self.make_exploration()
        ).to(problem.device)
        self.stages = self.make_stages()
        self.init_loss = self.make_init_loss() if config.init == "bc" else None
        self.target_updater = self.make_target_updater()
        self.replay = self.make_replay()
        if problem.device.type != "cpu":
            self.replay.append_transform(ImageCodecs(self.images, device=problem.device))
        for transform in self.make_transforms():
            self.replay.append_transform(transform)
        self.optimizer = self.make_optimizer()
        self.stepper = self.make_stepper()

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

    def make_init_loss(self) -> LossModule:
        """Return the loss of the pretraining updates with ``init="bc"``.

        Raises:
            ConfigError: the policy is not a distribution of actions.
        """
        policy = self.trained_policy
        if not isinstance(policy, ProbabilisticTensorDictSequential):
            name = ALGORITHMS.name_of(type(self.config))
            why = "has no actor for cloning to initialise; leave out init"
            raise PartError("algorithm", name, why)
        loss = BehaviourCloningLoss(policy, "kl", self.config.init_entropy_weight)
        loss.set_keys(action=keys.TARGET_ACTION)
        return loss

    def make_acting_transforms(self) -> list[Transform]:
        """Return the transforms of the observation that the acting policy sees; by default the
        images' codecs."""
        return [ImageCodecs(self.images)]

    def make_exploration(self) -> TensorDictModuleBase | None:
        """Return what changes the actions of the acting policy, called only when it explores; by
        default None, which leaves exploration to the policy's distribution."""
        return None

    def make_stages(self) -> list[LossFunction]:
        """Return the losses of an update in the order in which they are minimised, each after the
        optimisers' step on the one before; by default the loss module alone."""
        return [self.loss]

    def due_stages(self) -> Sequence[LossFunction]:
        """Return the stages of the update that follows `updates` others; by default all. An
        algorithm that updates its policy less often than its critics leaves one out."""
        return self.stages

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

    def make_transforms(self) -> list[Transform]:
        """Return the transforms of the replay, called on sampled batches and, their inverse, on new
        transitions; by default none."""
        return []

    def make_optimizer(self) -> Optimizer:
        """Return the optimiser of all terms of the loss but those of `make_term_optimizers`."""
        return self.adam(self.loss.parameters())

    def make_term_optimizers(self) -> Mapping[str, Mapping[str, Optimizer]]:
        """Return the optimisers of single terms of the loss, by the names of term and optimiser;
        by default none. Their terms are in a stage without others."""
        return {}

    def make_stepper(self) -> OptimizationStepper:
        """Return what takes the gradient steps of an update: by default all optimisers with their
        schedules. One of TorchRL's takes a step of `optimizer` on the sum of all stages, without a
        schedule."""
        return Optimizers(
            self.optimizer,
            self.make_term_optimizers(),
            self.make_scheduler,
            clamp=self.config.gradient_clamp,
            clamped=self.network_parameters(),
        )

    def make_scheduler(self, optimizer: Optimizer) -> LRScheduler:
        """Return the schedule of an optimiser's learning rate, which steps once per update."""
        end, updates = self.config.learning_rate_end_factor, self.problem.total_updates
        return LinearLR(optimizer, start_factor=1.0, end_factor=end, total_iters=updates)

    def adam(self, parameters: Iterable[nn.Parameter], factor: float = 1.0) -> Optimizer:
        """Return Adam for some parameters with a factor on the learning rate, and with weight decay
        on those of the networks only."""
        others = {id(parameter): parameter for parameter in parameters}
        decayed = [p for p in self.network_parameters() if others.pop(id(p), None) is not None]
        groups = [
            {"params": decayed, "weight_decay": self.config.weight_decay},
            {"params": list(others.values()), "weight_decay": 0.0},
        ]
        groups = [group for group in groups if group["params"]]
        return Adam(groups, lr=factor * self.config.learning_rate, fused=True)

    def network_parameters(self) -> list[nn.Parameter]:
        """Return the parameters to which weight decay and the gradient's bound apply."""
        return list(self.loss.parameters())

    # -- data --------------------------------------------------------------------------------

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the actions nearest to given ones [..., A] among those that the policy can choose;
        by default it can choose all. Demonstrations execute what is learnt: these actions."""
        return action

    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDict:
        """Return collected data as the transitions [N] that the replay stores.

        Args:
            data: steps of any batch shape, those of an episode in order.
            is_demonstration: whether they are demonstrations.

        Raises:
            KeyError: an entry is missing.
        """
        return as_transitions(
            data,
            self.images,
            self.vectors,
            is_demonstration=is_demonstration,
            imitates=self.config.imitates,
        )

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Process the demonstrations, TensorDicts [T], before the first update; by default they
        enter the replay."""
        for episode in episodes:
            self.extend(self.to_transitions(episode, is_demonstration=True))

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N], and augmented copies if configured, to the replay, except those with
        a fault."""
        new = self.entries_per_transition * len(transitions)
        if len(self.replay) + new > self.config.buffer_size:
            self.host_tasks.run()  # before its transitions are overwritten: deferred priorities
        self.replay.extend(transitions)

    @property
    def replay_size(self) -> int:
        """Number of transitions in the replay."""
        return len(self.replay)

    def sample(self, *, demonstrations_only: bool = False) -> TensorDictBase:
        """Return an augmented batch from the replay on the learner's device, on request only its
        demonstrations."""
        sampler = self._prioritized_sampler()
        if sampler is not None:
            sampler.anneal(self._annealing_progress())
        batch, device = self.replay.sample(), self.problem.device
        is_demonstration = batch[keys.IS_DEMONSTRATION] if demonstrations_only else None
        if device.type != "cpu":
            batch = batch_to_device(batch, device)
        if is_demonstration is None:
            return batch
        return batch[to_device(is_demonstration.reshape(-1).nonzero()[:, 0], device)]

    # -- updates -----------------------------------------------------------------------------

    def update(self) -> TensorDict:
        """Take the gradient steps on a batch, and update the target network and the priorities;
        return scalars without gradient, all on one device.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        batch = self.sample()
        scalars = self.minimize(batch, self.due_stages())
        if self._prioritized_sampler() is not None:  # whose trees are on the CPU
            errors = {key: batch[key] for key in ("index", keys.TD_ERROR)}
            self.host_tasks.submit(errors, self._set_priorities)
        return scalars

    def compile(self, mode: CompileMode) -> None:
        """Compile the loss and its gradient, except those of ``pretraining_option``.

        Raises:
            ConfigError: the algorithm cannot be compiled, the mode is unknown, or the system has no
                compiler.
        """
        if not self.config.is_compilable:
            raise ConfigError("compile_mode: this algorithm cannot be compiled; leave it out")
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
        the expert's transitions in a batch. It counts, returns and raises as `update`."""
        if self.init_loss is None:
            return self.update()
        return self.minimize(self.sample(demonstrations_only=True), [self.init_loss])

    def minimize(self, batch: TensorDictBase, stages: Sequence[LossFunction]) -> TensorDict:
        """Take the steps of `step`, with its arguments and result, and count the update."""
        before = len(self.host_tasks)
        scalars = self.step(batch, stages)
        if self.averaged_policy is not None:
            self.averaged_policy.update_parameters(self.trained_policy)
        self.updates += 1
        self.host_tasks.run(before)
        return scalars

    def step(self, batch: TensorDictBase, stages: Sequence[LossFunction]) -> TensorDict:
        """Take the gradient steps on several sums of losses of a batch, then one step of the target
        network.

        Args:
            batch: sampled transitions.
            stages: see `make_stages`.

        Returns:
            The scalars of all stages, without gradient.

        Raises:
            FloatingPointError: a loss is not finite.
            ValueError: the losses of a stage have different optimisers.
        """
        update = Update(stages, self._check_finite, self.optimizer, self.config.gradient_clamp)
        scalars = self.stepper.step(update, batch)
        self.update_target()
        return scalars

    def _check_finite(self, scalars: TensorDictBase, is_finite: Tensor) -> Tensor | None:
        values = {**scalars, IS_FINITE: is_finite}
        self.host_tasks.submit(values, partial(check_finite, self.updates))
        return is_finite if self.host_tasks.is_deferred else None

    def update_target(self) -> None:
        """Move the target network, if there is one, after the gradient steps of an update."""
        if self.target_updater is not None:
            self.target_updater.step()

    def _prioritized_sampler(self) -> ExpertPrioritizedSampler | None:
        sampler = self.replay.sampler
        return sampler if isinstance(sampler, ExpertPrioritizedSampler) else None

    # -- state -------------------------------------------------------------------------------

    def _stateful_parts(self) -> dict[str, nn.Module]:
        names = ("loss", "averaged_policy")
        parts = {name: getattr(self, name) for name in names}
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
        """Restore the replay from a `replay_state`.

        Raises:
            ConfigError: its transitions have other entries than those of this learner.
        """
        self.replay.load_state_dict(state)
        has_target = self.config.imitates in WITH_TARGET
        expected = {keys.IS_DEMONSTRATION: True, keys.TARGET_ACTION: has_target}
        for key, is_expected in expected.items():
            if len(self.replay) and (key in self.replay.stored_keys) != is_expected:
                raise ConfigError(
                    f"the saved transitions {'lack' if is_expected else 'have'} the entry {key!r}: "
                    "another version of the library wrote them; start the run again in another "
                    "run_dir"
                )
