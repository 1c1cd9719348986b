"""An update of Equi SACfD with escnn's layers, as the reference implementation computes it.

Network and losses are those of appendix G.2. Every forward pass expands the filters, critic and
actor are trained one after the other, the actor's term differentiates through a critic of its own
forward pass, and everything is in float32. What `ba_torchrl` computes in another way is measured
against it.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.sac import compute_rsample_log_prob

from ba_torchrl.core import keys
from ba_torchrl.modules.actor_critic.equivariant import ActionFields
from ba_torchrl.modules.actor_critic.gaussian_policy import UnitTanhNormal
from ba_torchrl.modules.actor_critic.trunk import scale_from_log_std, trunk_stages
from profiling.learning import (
    CLOSE_LOOP,
    SEED,
    LearningUnit,
    make_learner,
)
from profiling.table import CPU, Bench, Row, measurement, timed_row

if TYPE_CHECKING:
    from escnn.group import Representation
    from escnn.gspaces import GSpace2D
    from escnn.nn import FieldType

SIZE = (8, 128, 64)
"""Rotations, pixels and fields of the network that is measured."""
ACTION_SEQUENCE = "pxyzr"
GAMMA, TAU, LEARNING_RATE, ALPHA_INIT, TARGET_ENTROPY = 0.99, 0.01, 1e-3, 0.01, -5.0
"""Values of appendix G.2 and, for tau, of the reference implementation."""


def _convolution(inputs: FieldType, outputs: FieldType, size: int, padding: int = 0) -> nn.Module:
    """Return escnn's convolution, with random filters of the variance 2 / fan-in.

    escnn's own initialisation of a layer of this size takes minutes.
    """
    from profiling.planar_escnn import nn as enn

    layer = enn.R2Conv(inputs, outputs, size, padding=padding, initialize=False)
    with torch.no_grad():
        layer.weights.normal_()
        filters, _ = layer.expand_parameters()
        fan_in = filters[0].numel()
        layer.weights.mul_(math.sqrt(2 / fan_in) / filters.std())
    return layer


class Fields:
    """Fields of escnn on one symmetry group.

    Args:
        gspace: the group and its action on the plane.
    """

    def __init__(self, gspace: GSpace2D) -> None:
        self.gspace = gspace

    def of(self, *fields: tuple[Representation, int]) -> FieldType:
        """Return the type of fields, each a representation and its multiplicity."""
        from profiling.planar_escnn import nn as enn

        return enn.FieldType(self.gspace, [r for r, count in fields for _ in range(count)])

    def regular(self, count: int) -> FieldType:
        """Return the type of regular fields."""
        return self.of((self.gspace.regular_repr, count))

    def trivial(self, count: int) -> FieldType:
        """Return the type of invariants."""
        return self.of((self.gspace.trivial_repr, count))


class Trunk(nn.Module):
    """Depth image and holding flag to regular fields of one pixel.

    Args:
        fields: of the symmetry group.
        image_size: pixels, 64 or 128.
        n_hidden: fields of the last layer.
    """

    def __init__(self, fields: Fields, image_size: int, n_hidden: int) -> None:
        from profiling.planar_escnn import nn as enn

        super().__init__()
        n = n_hidden
        self.in_type = fields.trivial(2)
        layers, inputs = [], self.in_type
        stages = trunk_stages(image_size, (n / 8, n / 4, n / 2, n, 2 * n, n, n))
        for width, padding, pools in stages:
            outputs = fields.regular(int(width))
            layers += [_convolution(inputs, outputs, 3, padding), enn.ReLU(outputs)]
            if pools:
                layers.append(enn.PointwiseMaxPool2D(outputs, 2))
            inputs = outputs
        self.layers = nn.ModuleList(layers)
        self.out_type = inputs

    def forward(self, depth: Tensor, holding: Tensor) -> Tensor:
        """Return features [B, F, 1, 1] of depth [B, 1, H, W] and holding [B, 1]."""
        holds = holding.to(depth)[..., None, None].expand_as(depth)
        x = self.in_type(torch.cat([depth, holds], dim=1))
        for layer in self.layers:
            x = layer(x)
        return x.tensor


class Actor(nn.Module):
    """Gaussian policy before the squashing.

    Args:
        fields: of the symmetry group.
        image_size: pixels.
        n_hidden: fields of the last layer.
    """

    def __init__(self, fields: Fields, image_size: int, n_hidden: int) -> None:
        super().__init__()
        self.trunk = Trunk(fields, image_size, n_hidden)
        self.action = ActionFields(ACTION_SEQUENCE)
        outputs = fields.of(*self.action.types(fields.gspace, extra_invariants=self.action.size))
        self.head = _convolution(self.trunk.out_type, outputs, 1)

    def forward(self, depth: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), each [B, A]."""
        features = self.trunk.out_type(self.trunk(depth, holding))
        loc, log_std = self.head(features).tensor.flatten(1).split(self.action.size, dim=-1)
        return self.action.ungroup(loc), scale_from_log_std(log_std)


class Critic(nn.Module):
    """Twin values on shared features.

    Args:
        fields: of the symmetry group.
        image_size: pixels.
        n_hidden: fields of the last layer.
    """

    def __init__(self, fields: Fields, image_size: int, n_hidden: int) -> None:
        from profiling.planar_escnn import nn as enn

        super().__init__()
        self.trunk = Trunk(fields, image_size, n_hidden)
        self.action = ActionFields(ACTION_SEQUENCE)
        regular = self.trunk.out_type
        self.in_type = regular + fields.of(*self.action.types(fields.gspace))
        self.hidden = nn.ModuleList(_convolution(self.in_type, regular, 1) for _ in range(2))
        self.invariant = nn.Sequential(enn.ReLU(regular), enn.GroupPooling(regular))
        invariants, value = fields.trivial(n_hidden), fields.trivial(1)
        self.values = nn.ModuleList(_convolution(invariants, value, 1) for _ in range(2))

    def forward(self, depth: Tensor, holding: Tensor, action: Tensor) -> Tensor:
        """Return twin values [B, 2]."""
        grouped = self.action.group(action)[..., None, None]
        x = self.in_type(torch.cat([self.trunk(depth, holding), grouped], dim=1))
        heads = zip(self.hidden, self.values, strict=True)
        return torch.cat(
            [value(self.invariant(hidden(x))).tensor.flatten(1) for hidden, value in heads], dim=1
        )


class EscnnSACfD:
    """Networks, optimisers and the update.

    Args:
        group_order: number of rotations.
        image_size: pixels, 64 or 128.
        n_hidden: regular fields of the last layers.
        device: of the networks.
    """

    def __init__(
        self, group_order: int, image_size: int, n_hidden: int, device: torch.device = CPU
    ) -> None:
        from profiling.planar_escnn import gspaces

        fields = Fields(gspaces.rot2dOnR2(group_order))
        self.actor = Actor(fields, image_size, n_hidden).to(device)
        self.critic = Critic(fields, image_size, n_hidden).to(device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(ALPHA_INIT), device=device))
        self.optimizers = {
            name: torch.optim.Adam(parameters, LEARNING_RATE)
            for name, parameters in (
                ("qvalue", self.critic.parameters()),
                ("actor", self.actor.parameters()),
                ("alpha", [self.log_alpha]),
            )
        }

    def update(self, batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Train critic, actor and temperature, move the target, and return the three losses.

        Args:
            batch: transitions [B], of which the behaviour term imitates ``action``.
        """
        qvalue = self.qvalue_loss(batch)
        self._step("qvalue", qvalue)
        actor, log_prob = self.actor_loss(batch)
        self._step("actor", actor)
        alpha = -(self.log_alpha * (log_prob.detach() + TARGET_ENTROPY)).mean()
        self._step("alpha", alpha)
        with torch.no_grad():
            for old, new in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                old.lerp_(new, TAU)
        return qvalue.detach(), actor.detach(), alpha.detach()

    def qvalue_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the squared errors of both values, averaged over the batch and added."""
        following = batch[keys.NEXT]
        with torch.no_grad():
            action, log_prob = self._sample(following)
            values = self.target(following[keys.DEPTH], following[keys.HOLDING], action)
            value = values.amin(dim=1) - self.log_alpha.exp() * log_prob
            lasts = ~following[keys.TERMINATED][:, 0]
            target = following[keys.REWARD][:, 0] + GAMMA * lasts * value
        q = self.critic(batch[keys.DEPTH], batch[keys.HOLDING], batch[keys.ACTION])
        return 2 * F.mse_loss(q, target[:, None].expand_as(q))

    def actor_loss(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the policy term plus the behaviour term, and the log-probabilities [B]."""
        action, log_prob = self._sample(batch)
        q = self.critic(batch[keys.DEPTH], batch[keys.HOLDING], action)
        policy = (self.log_alpha.exp().detach() * log_prob - q.amin(dim=1)).mean()
        errors = (action - batch[keys.ACTION]).square().mean(dim=1)
        is_demonstration = batch[keys.IS_DEMONSTRATION][:, 0]
        imitation = (errors * is_demonstration).sum() / is_demonstration.sum().clamp_min(1)
        return policy + imitation, log_prob

    def _sample(self, observation: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return actions [B, A], with gradient, and their log-probabilities [B]."""
        gaussian = self.actor(observation[keys.DEPTH], observation[keys.HOLDING])
        return compute_rsample_log_prob(UnitTanhNormal(*gaussian))

    def _step(self, name: str, loss: Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@measurement("learning/escnn_sacfd_update")
def measure_escnn(bench: Bench) -> list[Row]:
    """Update of Equi SACfD, and the same with escnn's layers, without sampling and augmentation."""
    group_order, image_size, n_hidden = SIZE
    network = {"name": "equi", "group_order": group_order, "n_hidden": n_hidden}
    learner = make_learner(bench, CLOSE_LOOP, network, image_size)
    batch = learner.sample()
    torch.manual_seed(SEED)
    escnn = EscnnSACfD(group_order, image_size, n_hidden, bench.device)
    work = f"Equi SACfD update, batch 64, {image_size} px, C{group_order}, {n_hidden} fields"
    calls = {work: learner.update, f"{work}, escnn's layers": lambda: escnn.update(batch)}
    times = bench.time_against({"unit": LearningUnit(bench.device)}, calls)
    return [timed_row(call, "s", times[call], times["unit"]) for call in calls]
