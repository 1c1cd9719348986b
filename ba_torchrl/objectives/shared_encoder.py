"""The networks of a loss with a stochastic actor and several critics on a shared encoder."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.objectives.sac import compute_rsample_log_prob


class SharedEncoderCritics:
    """Mixin of a loss module with an actor, an encoder and K critics that see its features."""

    def _convert_networks(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        encoder_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
    ) -> None:
        """Make the networks functional, with targets of encoder and critics.

        Parameters that the actor shares with the encoder are constants in the actor's terms, so
        that the critics alone train them. The constants share the parameters' memory: the networks
        are on their device before, and the loss is neither copied nor moved afterwards.
        """
        self.convert_to_functional(actor_network, "actor_network")
        self.convert_to_functional(encoder_network, "encoder_network", create_target_params=True)
        self.convert_to_functional(qvalue_network, "qvalue_network", create_target_params=True)
        shared = set(encoder_network.parameters())
        for key, parameter in list(self.actor_network_params.items(True, True)):
            if parameter in shared:
                self.actor_network_params.set(key, parameter.data)

    def _sample_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return an action [..., A] drawn with gradient and its log-probability [...]."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            observation = tensordict.select(*self.actor_network.in_keys)
            return compute_rsample_log_prob(self.actor_network.get_dist(observation))

    def _features(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        with params.to_module(self.encoder_network, preserve_module_state=False):
            observation = tensordict.select(*self.encoder_network.in_keys)
            return self.encoder_network(observation)[self.encoder_network.out_keys[0]]

    def _values(self, features: Tensor, action: Tensor, params: TensorDictBase) -> Tensor:
        """Return the values [..., K] of an action at given features."""
        inputs = TensorDict(
            {self.encoder_network.out_keys[0]: features, self.tensor_keys.action: action},
            batch_size=action.shape[:-1],
        )
        with params.to_module(self.qvalue_network, preserve_module_state=False):
            return self.qvalue_network(inputs)[self.tensor_keys.state_action_value]
