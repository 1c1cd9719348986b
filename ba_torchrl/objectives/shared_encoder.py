"""The networks of a loss with a stochastic actor and several critics on a shared encoder."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives.sac import compute_rsample_log_prob


class SharedEncoderCritics:
    """Mixin of a loss module with an actor, an encoder and K critics that see its features."""

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
