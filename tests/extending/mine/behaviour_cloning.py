"""An algorithm: behaviour cloning."""

from typing import ClassVar

from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.base import ALGORITHMS, Learner, LearnerConfig
from ba_torchrl.core import keys
from ba_torchrl.modules.base import ActorCriticSpec


class BehaviourCloningLoss(LossModule):
    """Mean squared error of the policy's mode to the expert's action."""

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(self, actor_network):
        """Register the parameters of the policy."""
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")

    def forward(self, tensordict):
        """Return the error of a batch."""
        with self.actor_network_params.to_module(self.actor_network):
            mode = self.actor_network.get_dist(tensordict).deterministic_sample
        error = (mode - tensordict[keys.TARGET_ACTION]).square().mean()
        return TensorDict({"loss_actor": error})


@ALGORITHMS.register("mine/behaviour_cloning")
class BehaviourCloningConfig(LearnerConfig):
    """Regression of the expert's actions, also in states that the policy visits (DAgger)."""

    controls: ClassVar[frozenset[str]] = frozenset({"close_loop"})
    imitates: ClassVar[str] = "expert_everywhere"

    def build(self, network, problem):
        """Return the algorithm."""
        return BehaviourCloning(self, network, problem)


class BehaviourCloning(Learner):
    """Training of a policy by regression, with every other part of `Learner`."""

    def make_networks(self, network):
        """Return the actor of an actor-critic network."""
        spec = ActorCriticSpec(self.images, self.problem.actions.sequence)
        return network.build(spec).actor

    def make_policy(self, networks):
        """Return the distribution of the action."""
        return ProbabilisticActor(
            TensorDictModule(networks, self.observation_keys, ["loc", "scale"]),
            in_keys=["loc", "scale"],
            out_keys=[keys.ACTION],
            distribution_class=TanhNormal,
        )

    def make_loss(self, networks):
        """Return the regression."""
        return BehaviourCloningLoss(self.make_policy(networks))
