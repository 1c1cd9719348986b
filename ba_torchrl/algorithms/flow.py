"""Imitation of an expert by chunks of actions, which a network draws from noise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Transform

from ba_torchrl.algorithms.base import Learner, SeedUse
from ba_torchrl.algorithms.flow_config import FlowConfig, FlowDAggerConfig
from ba_torchrl.core import keys
from ba_torchrl.data.transitions import chunk_windows
from ba_torchrl.modules.chunks import ChunkFlow, ChunkPolicy, chunk_head
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.objectives.flow import FlowMatchingLoss


class Flow(Learner):
    """A policy of action chunks, trained on demonstrations."""

    config: FlowConfig

    def make_networks(self, network: NetworkConfig) -> ChunkFlow:
        """Return the encoder of an actor-critic network with a head for chunks."""
        config, networks = self.config, network.build(self.network_spec)
        head = chunk_head(networks, self.network_spec, config.horizon, config.hidden)
        return ChunkFlow(networks.encoder, head, config.steps).to(self.problem.device)

    def make_policy(self, networks: ChunkFlow) -> ChunkPolicy:
        """Return the policy."""
        size, seed = self.problem.actions.size, self.problem.derived_seed(SeedUse.EXPLORATION)
        return ChunkPolicy(networks, self.observation_keys, size, self.config.executed, seed)

    def make_loss(self, networks: ChunkFlow) -> FlowMatchingLoss:
        """Return the error of the clean chunks."""
        return FlowMatchingLoss(self.make_policy(networks).flow, self.config.draws)

    def make_transforms(self, networks: ChunkFlow) -> list[Transform]:
        """Return the rotation of sampled transitions."""
        return self.config.rotation.build(self.problem, self.images, self.vectors)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store the steps of demonstrations [T] in which the expert's action is known, with the
        chunks that begin there."""
        for episode in episodes:
            data = self.to_transitions(episode, is_demonstration=True)
            is_known = data[keys.IS_DEMONSTRATION].squeeze(-1)
            if keys.TARGET_CHUNK in data:
                self.extend(data)
                continue
            is_executed = episode.get(keys.IS_EXPERT, torch.ones_like(is_known)[:, None])
            chunk, is_valid = chunk_windows(
                data[keys.TARGET_ACTION], is_known, is_executed.squeeze(-1), self.config.horizon
            )
            data.set(keys.TARGET_CHUNK, chunk).set(keys.TARGET_CHUNK_MASK, is_valid)
            self.extend(data[is_known])

    def generators(self) -> dict[str, torch.Generator]:
        """Return the generator of the policy's noise."""
        return {"exploration": self.policy.policy.generator}


class FlowDAgger(Flow):
    """A policy of action chunks, also trained on the expert's chunks in the states that it
    visits."""

    config: FlowDAggerConfig

    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDict:
        """Return steps of any batch shape as transitions [N], with the chunks that the expert
        played from their states on; demonstrations from a file have none."""
        out = super().to_transitions(data, is_demonstration=is_demonstration)
        if keys.EXPERT_CHUNK in data or not is_demonstration:
            out[keys.TARGET_CHUNK] = data[keys.EXPERT_CHUNK].flatten(0, data.ndim - 1)
            out[keys.TARGET_CHUNK_MASK] = data[keys.EXPERT_CHUNK_MASK].flatten(0, data.ndim - 1)
        return out
