"""Soft updates of target networks with a rate for each of them."""

from __future__ import annotations

from collections.abc import Mapping

from torchrl.objectives import LossModule, SoftUpdate


class SoftUpdateByNetwork(SoftUpdate):
    """TorchRL's soft update, in which some networks have other rates.

    Args:
        loss_module: with target networks.
        tau: weight of the online parameters.
        taus: other weights, by the name of the network in the loss, such as "encoder_network".
    """

    def __init__(self, loss_module: LossModule, *, tau: float, taus: Mapping[str, float]) -> None:
        super().__init__(loss_module, tau=tau)
        self.tau = tau
        self.taus = {f"{name}_params": value for name, value in taus.items()}

    def step(self) -> None:
        """Move every target towards its online network."""
        for name, source in self._sources.items():
            target = self._targets.get(f"target_{name}")
            target.data.lerp_(source.data, self.taus.get(name, self.tau))
