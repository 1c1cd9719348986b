"""Hyper-parameters of algorithms, each of which is built for a network and a problem."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.algorithms.parts.optimizer import OptimizerConfig
from ba_torchrl.algorithms.parts.replay import Replay, Uniform
from ba_torchrl.core.choices import Control, Imitation
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.errors import PartError
from ba_torchrl.core.registry import Registry
from ba_torchrl.modules.config import NETWORKS, NetworkConfig

if TYPE_CHECKING:
    from ba_torchrl.algorithms.problem import Problem


class LearnerConfig(StrictModel):
    """Hyper-parameters of an algorithm, from which it is built for a network and a problem.

    Its module imports no torch: those of this package name the class of the algorithm in `learner`.
    Another one can override `build` instead.

    Learning rate, batch and replay are those of appendix G.2. Each other field says where its
    default is from.
    """

    learner: ClassVar[str]
    """The `ba_torchrl.algorithms.base.Learner`, as "module:Class", which `build` imports."""
    controls: ClassVar[frozenset[Control]]
    """Controls of the tasks that the algorithm supports."""
    collects: ClassVar[bool] = True
    """Whether the policy collects transitions; if not, all updates are on the demonstrations."""
    is_compilable: ClassVar[bool] = True
    """Whether `Learner.compile` is possible."""
    acting: ClassVar[frozenset[str]] = frozenset()
    """Fields that a trained policy acts by and that do not affect learning."""

    optimizer: OptimizerConfig = OptimizerConfig()
    """Steps along the gradient."""
    batch_size: int = Field(default=64, ge=1)
    """Transitions per update."""
    replay: Replay = Uniform()
    """Transitions of demonstrations and collection, and how a batch is drawn."""

    @model_validator(mode="after")
    def _check_batch(self) -> Self:
        if self.batch_size < self.replay.least_batch:
            least, name = self.replay.least_batch, self.replay.name
            raise ValueError(f"batch_size must be at least {least} with replay.name={name}")
        return self

    @property
    def imitates(self) -> Imitation:
        """Which action the losses imitate, and on which transitions; by default the executed action
        of demonstrations."""
        return "executed"

    @property
    def expert_chunk(self) -> int:
        """Number of the expert's next actions that the environments of demonstrations and
        collection add to observations (`EnvConfig.expert_chunk`); by default none."""
        return 0

    @property
    def first_updates(self) -> int:
        """Number of first updates of a run that minimise those of `Learner.make_first_losses`, all
        on the demonstrations; by default none."""
        return 0

    def check(self, network: NetworkConfig, control: Control) -> None:
        """Raise `ConfigError` unless algorithm and network support the task's control."""
        if control not in self.controls:
            known = [name for name in ALGORITHMS if control in ALGORITHMS[name].controls]
            why = f"learns {' and '.join(sorted(self.controls))} tasks, not {control} ones"
            name = ALGORITHMS.name_of(type(self))
            raise PartError("algorithm", name, why, known, f"{control} tasks")
        if network.control != control:
            known = [name for name in NETWORKS if NETWORKS[name].control == control]
            why, name = f"is for {network.control} tasks", NETWORKS.name_of(type(network))
            raise PartError("network", name, why, known, f"{control} tasks")

    def build(self, network: NetworkConfig, problem: Problem) -> Any:
        """Return a freshly initialised `ba_torchrl.algorithms.base.Learner`."""
        return resolve_name(self.learner)(self, network, problem)


ALGORITHMS: Registry[type[LearnerConfig]] = Registry(
    "algorithm", "ba_torchrl.algorithms", LearnerConfig, "_config"
)
