"""Hyper-parameters of behaviour cloning and DAgger."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.parts.replay import Uniform
from ba_torchrl.algorithms.parts.rotation import AnyRotation, NoRotation, Sampled
from ba_torchrl.core.choices import Control, Imitation
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.modules.config import NetworkConfig


class ImitationConfig(LearnerConfig):
    """Hyper-parameters of a policy that is trained on the expert's actions alone.

    The loss is the divergence of sampled actions from the expert's in close-loop tasks, and the
    cross-entropy of the Q network's choices in open-loop tasks; see
    `ba_torchrl.objectives.imitation`.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop", "open_loop"})

    rotation: AnyRotation = NoRotation()
    """Of sampled transitions: about the z axis in close loop, rigid transforms in open loop."""
    replay: Uniform = Uniform()
    equal_moves: bool = True
    """Whether any of the moves that the expert holds for equal is imitated, in tasks whose expert
    gives them, instead of its own alone."""

    def check(self, network: NetworkConfig, control: Control) -> None:
        """As for `LearnerConfig`; a rotation of the other control is refused too."""
        super().check(network, control)
        own = isinstance(self.rotation, Sampled) == (control == "close_loop")
        if not own and self.rotation.name != "none":
            other = "open_loop" if control == "close_loop" else "close_loop"
            raise ConfigError(
                f"algorithm.rotation.name: {self.rotation.name!r} transforms {other} "
                f"transitions; leave it at 'none' for {control} tasks"
            )


@ALGORITHMS.register("bc")
class BCConfig(ImitationConfig):
    """Hyper-parameters of behaviour cloning (Pomerleau, "ALVINN: An Autonomous Land Vehicle in a
    Neural Network", 1989), whose updates are all on the demonstrations."""

    learner: ClassVar[str] = "ba_torchrl.algorithms.imitation:BC"
    collects: ClassVar[bool] = False
    imitates: ClassVar[Imitation] = "expert"


@ALGORITHMS.register("dagger")
class DAggerConfig(ImitationConfig):
    """Hyper-parameters of DAgger (Ross et al., 2011).

    After the demonstrations, the executed action is the expert's with a probability beta and the
    policy's otherwise. Beta starts at one, as in Ross et al. (2011), section 3, and decreases with
    every update. A policy trained by few updates stops where the expert's action changes abruptly;
    with a beta of zero, such states then fill the replay. Several updates per step help
    (``updates_per_step``).
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.imitation:DAgger"
    imitates: ClassVar[Imitation] = "expert_everywhere"

    beta_init: float = Field(default=1.0, ge=0, le=1)
    """Probability of executing the expert's action at the first update."""
    beta_updates: int = Field(default=1000, ge=1)
    """Updates over which that probability decreases linearly to zero, those on the demonstrations
    alone included."""
