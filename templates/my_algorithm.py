"""An algorithm: TD3+BC (Fujimoto and Gu, 2021), from demonstrations alone."""

from typing import ClassVar

from pydantic import Field
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate, TD3BCLoss

from ba_torchrl.algorithms.base import ALGORITHMS, Learner, LearnerConfig
from ba_torchrl.core import keys
from ba_torchrl.modules import ActionValue


class DeterministicActor(nn.Module):
    """The squashed mean of an actor: observation -> action [..., A]."""

    def __init__(self, actor):
        super().__init__()
        self.actor = actor

    def forward(self, *observation):
        """Return the action."""
        return self.actor(*observation)[0].tanh()


@ALGORITHMS.register("mine/my_algorithm")
class MyAlgorithmConfig(LearnerConfig):
    """Hyper-parameters, with the defaults of Fujimoto and Gu (2021), but for `alpha`."""

    controls: ClassVar[frozenset[str]] = frozenset({"close_loop"})
    collects: ClassVar[bool] = False
    imitates: ClassVar[str] = "none"

    alpha: float = Field(default=0.25, ge=0)
    """Weight of the value of the policy's action, in units of its mean absolute value. Fujimoto and
    Gu have 2.5. With sparse rewards, the first values are noise, which such a policy follows."""
    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.005, gt=0, le=1)
    """Weight of a network in the update of its target."""
    policy_noise: float = Field(default=0.2, ge=0)
    """Standard deviation of the noise of the targets' actions, which is clipped at 0.5."""
    policy_every: int = Field(default=2, ge=1)
    """Updates of the critics per update of the policy."""

    def build(self, network, problem):
        """Return a freshly initialised learner."""
        return MyAlgorithm(self, network, problem)


class MyAlgorithm(Learner):
    """A deterministic policy and two critics, each with an encoder of its own."""

    def make_networks(self, network):
        """Return the actor and both critics."""
        first, second, third = (network.build(self.network_spec) for _ in range(3))
        critics = [ActionValue(each.encoder, each.critic) for each in (second, third)]
        return DeterministicActor(first.actor), critics

    def make_policy(self, networks):
        """Return the policy, from the observation to ``action``."""
        return TensorDictModule(networks[0], self.observation_keys, [keys.ACTION])

    def make_loss(self, networks):
        """Return TorchRL's loss."""
        inputs = [*self.observation_keys, keys.ACTION]
        loss = TD3BCLoss(
            self.make_policy(networks),
            [TensorDictModule(each, inputs, ["state_action_value"]) for each in networks[1]],
            bounds=(-1.0, 1.0),
            alpha=self.config.alpha,
            policy_noise=self.config.policy_noise,
            deactivate_vmap=True,
        )
        loss.make_value_estimator(gamma=self.config.gamma)
        return loss

    def make_stages(self, loss):
        """Return the losses of an update, each minimised after a step on the one before."""
        return [self.critic_loss, self.actor_loss]

    def due_stages(self):
        """Return the stages of the next update; the policy's is not in each."""
        return self.stages[: 1 if self.updates % self.config.policy_every else 2]

    def critic_loss(self, batch):
        """Return the loss of the critics, by a name that begins with ``loss_``."""
        value, _ = self.loss.qvalue_loss(batch)
        return TensorDict({"loss_qvalue": value})

    def actor_loss(self, batch):
        """Return the loss of the policy and, of it, the distance to the demonstrated actions."""
        value, found = self.loss.actor_loss(batch)
        return TensorDict({"loss_actor": value, "bc_loss": found["bc_loss"]})

    def make_target_updater(self, loss):
        """Return the soft update of the targets of policy and critics."""
        return SoftUpdate(loss, tau=self.config.tau)
