"""Hyper-parameters of flow matching on chunks of actions."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.parts.replay import Uniform
from ba_torchrl.algorithms.parts.rotation import NoRotation, Sampled
from ba_torchrl.core.choices import Control, Imitation


@ALGORITHMS.register("flow")
class FlowConfig(LearnerConfig):
    """Hyper-parameters of flow matching on the demonstrations' chunks of actions.

    As Diffusion Policy (Chi et al., 2023), with a rectified flow (Liu et al., 2022) in place of the
    diffusion and networks that learn in minutes on a CPU. With an equivariant network, the policy
    is equivariant (Wang et al., "Equivariant Diffusion Policy", 2024). Not part of the paper.
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.flow:Flow"
    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop"})
    collects: ClassVar[bool] = False
    imitates: ClassVar[Imitation] = "expert"
    acting: ClassVar[frozenset[str]] = frozenset({"executed", "steps"})

    rotation: Annotated[NoRotation | Sampled, Field(discriminator="name")] = NoRotation()
    """Of sampled transitions and their chunks about the z axis."""
    replay: Uniform = Uniform()
    horizon: int = Field(default=4, ge=1, le=100)
    """Number of actions in a chunk."""
    executed: int = Field(default=1, ge=1)
    """Number of a chunk's first actions that are executed before the policy draws the next
    chunk."""
    steps: int = Field(default=8, ge=1, le=1000)
    """Steps of Euler's method from noise to a chunk."""
    draws: int = Field(default=4, ge=1, le=1000)
    """Noises and times per chunk in an update, for which an image is encoded once."""
    hidden: int = Field(default=256, ge=1, le=4096)
    """Units of both hidden layers of the head."""

    @model_validator(mode="after")
    def _check_executed(self) -> Self:
        if self.executed > self.horizon:
            raise ValueError(
                f"executed ({self.executed}) must be at most horizon ({self.horizon}), the number "
                "of actions in a chunk"
            )
        return self


@ALGORITHMS.register("flow_dagger")
class FlowDAggerConfig(FlowConfig):
    """Hyper-parameters of DAgger (Ross et al., 2011) on chunks of actions.

    The policy acts after the updates on the demonstrations (``pretrain_updates``). In each state
    that it visits, the expert plays a chunk of its own, and the simulator then returns to the
    state, so that the chunk is what the expert would do from there on.
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.flow:FlowDAgger"
    collects: ClassVar[bool] = True
    imitates: ClassVar[Imitation] = "expert_everywhere"

    @property
    def expert_chunk(self) -> int:
        """The chunks' number of actions."""
        return self.horizon
