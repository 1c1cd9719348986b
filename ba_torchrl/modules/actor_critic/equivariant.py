"""The equivariant actor-critic (appendix G.2; "Equi SACfD"), also with strided convolutions.

Turning the scene by +90 degrees about z turns the image by ``torch.rot90(k=1)`` and (dx, dy) into
(-dy, dx). Rotations of steerable layers have the same sense, so (dx, dy) is a vector field without
a change of sign. Reflecting the scene's y axis reverses the columns of the image, dy and the yaw.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from ba_torchrl.modules.actor_critic.equivariant_config import EquivariantConfig
from ba_torchrl.modules.actor_critic.trunk import ImageTrunk, scale_from_log_std, trunk_stages
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec, Frames
from ba_torchrl.modules.steerable.layers import (
    FieldTypes,
    SteerableConv2d,
    SteerableLinear,
)
from ba_torchrl.modules.steerable.planar import PlanarGroup, Representation, planar_rotations


class ActionFields:
    """How the components of an action transform under rotations and reflections.

    (x, y) is a vector and the other components are invariant, except for the yaw r, which a
    reflection reverses.
    """

    def __init__(self, action_sequence: str, *, has_reflections: bool = False) -> None:
        if not {"x", "y"} <= set(action_sequence):
            raise ValueError(
                f"an equivariant network needs x and y in the action, got {action_sequence!r}"
            )
        self.size = len(action_sequence)
        self.has_reflections = has_reflections
        self.signed = [
            i for i, letter in enumerate(action_sequence) if letter == "r" and has_reflections
        ]
        """Indices of the components that a reflection reverses."""
        self.invariants = [
            i
            for i, letter in enumerate(action_sequence)
            if letter not in "xy" and i not in self.signed
        ]
        # Index in the action of each component of [vector, signed, invariants], and the inverse
        # permutation.
        vector = [action_sequence.index("x"), action_sequence.index("y")]
        self._grouped = [*vector, *self.signed, *self.invariants]
        self._restore = [self._grouped.index(i) for i in range(self.size)]

    def types(self, group: PlanarGroup, extra_invariants: int = 0) -> FieldTypes:
        """Return the fields [vector, signed, invariants], with extra invariants at the end."""
        rotation = group.irrep(1, 1) if self.has_reflections else group.irrep(1)
        # A half turn acts on x and y separately, so C_2 needs its one-dimensional irrep twice.
        fields = [(rotation, 2 // rotation.size)]
        if self.signed:
            fields.append((group.irrep(1, 0), len(self.signed)))
        count = len(self.invariants) + extra_invariants
        return [*fields, (group.trivial_repr, count)] if count else fields

    def group(self, action: Tensor) -> Tensor:
        """Return the action's components [..., A] as [vector, signed, invariants]."""
        return torch.stack([action[..., i] for i in self._grouped], dim=-1)

    def ungroup(self, fields: Tensor) -> Tensor:
        """Return the components [..., A] of [vector, signed, invariants] in the action's order."""
        return torch.stack([fields[..., i] for i in self._restore], dim=-1)

    def matrices(self, group: PlanarGroup) -> Tensor:
        """Return the matrices [G, A, A] of the group's elements, in the action's order."""
        return _matrices(self.types(group), group)[:, self._restore][:, :, self._restore]


class PoseFields:
    """How the pose of the gripper, the entry ``proprio``, transforms under rotations, reflections.

    Its position relative to the centre of the scene and the direction in which the fingers close
    are vectors; height and opening are invariant.
    """

    def __init__(self, spec: ActorCriticSpec, *, has_reflections: bool = False) -> None:
        if others := [key for key in spec.vectors if key != keys.PROPRIO]:
            raise ConfigError(
                f"network.vector_keys: it is unknown how {', '.join(others)} rotates with the "
                f"scene; an equivariant network takes {keys.PROPRIO!r} only"
            )
        self.is_observed = bool(spec.vectors)
        self.center_m = spec.center_m
        self.has_reflections = has_reflections

    def types(self, group: PlanarGroup) -> FieldTypes:
        """Return the fields [two vectors, two invariants], or none without ``proprio``."""
        if not self.is_observed:
            return []
        rotation = group.irrep(1, 1) if self.has_reflections else group.irrep(1)
        return [(rotation, 4 // rotation.size), (group.trivial_repr, 2)]

    def fields(self, vectors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return the fields [..., 6] of ``proprio`` [..., 8], or nothing of nothing."""
        if not vectors:
            return ()
        x, y, z, *quaternion, opening = vectors[0].unbind(dim=-1)
        i, j, k, w = quaternion
        closing = 1 - 2 * (j * j + k * k), 2 * (i * j + k * w)
        plane = (x - self.center_m[0], y - self.center_m[1], *closing)
        return (torch.stack([*plane, z, opening], dim=-1),)


class EquivariantEncoder(nn.Module):
    """An image trunk, with the fields of the gripper's pose appended to its features."""

    def __init__(self, trunk: ImageTrunk, pose: PoseFields) -> None:
        super().__init__()
        self.trunk = trunk
        self.pose = pose

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> Tensor:
        """Return fields [..., F] of depth [..., C, H, W], holding [..., 1] and ``proprio``."""
        return self.trunk(depth, holding, *self.pose.fields(vectors))


def steerable_linear(inputs: FieldTypes, outputs: FieldTypes) -> nn.Module:
    """Return a steerable map between vectors of fields, whose inputs may repeat representations."""
    merged: dict[str, tuple[Representation, int]] = {}
    for rep, count in inputs:
        merged[rep.name] = rep, count + merged.get(rep.name, (rep, 0))[1]
    linear = SteerableLinear(list(merged.values()), outputs)
    if len(merged) == len(inputs):
        return linear
    names = [rep.name for rep, _ in inputs]
    order = [i for name in merged for i, other in enumerate(names) if other == name]
    return nn.Sequential(Reordered([rep.size * count for rep, count in inputs], order), linear)


class Reordered(nn.Module):
    """A permutation of the parts of the last dimension.

    Args:
        sizes: of the parts.
        order: number of the part that is at each place.
    """

    def __init__(self, sizes: Sequence[int], order: Sequence[int]) -> None:
        super().__init__()
        self.sizes = list(sizes)
        self.order = list(order)

    def forward(self, x: Tensor) -> Tensor:
        """Return x [..., N] with its parts in the new order."""
        parts = x.split(self.sizes, dim=-1)
        return torch.cat([parts[i] for i in self.order], dim=-1)


class EquivariantActor(nn.Module):
    """Gaussian policy with equivariant mean and invariant log-std, before the squashing.

    Args:
        features: fields of the trunk and of the pose.
    """

    def __init__(
        self,
        trunk: ImageTrunk,
        features: FieldTypes,
        action: ActionFields,
        pose: PoseFields,
    ) -> None:
        super().__init__()
        self.trunk = trunk
        self.action = action
        self.pose = pose
        # The log standard deviations are invariant as well.
        outputs = action.types(features[0][0].group, extra_invariants=action.size)
        self.head = SteerableLinear(features, outputs)

    def forward(self, depth: Tensor, holding: Tensor, *vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), each [..., A], of depth [..., C, H, W], holding [..., 1] and, if it
        is observed, ``proprio`` [..., 8]."""
        fields = self.head(self.trunk(depth, holding, *self.pose.fields(vectors)))
        loc, log_std = fields.split(self.action.size, dim=-1)
        return self.action.ungroup(loc), scale_from_log_std(log_std)


class EquivariantTwinCritic(nn.Module):
    """Two invariant value heads on shared features and the action.

    Args:
        features: fields of the features, first regular ones.
    """

    def __init__(self, features: FieldTypes, action: ActionFields) -> None:
        super().__init__()
        self.action = action
        regular, count = features[0]
        group = regular.group
        self._group_order = regular.size
        inputs = [*features, *action.types(group)]
        self.hidden = nn.ModuleList(steerable_linear(inputs, [(regular, count)]) for _ in range(2))
        # From invariants to one value: the only steerable kernel is the identity, so this is a
        # plain linear layer.
        scalars, value = [(group.trivial_repr, count)], [(group.trivial_repr, 1)]
        self.values = nn.ModuleList(SteerableLinear(scalars, value) for _ in range(2))

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return twin values [..., 2] of features [..., F] and action [..., A]."""
        x = torch.cat([features, self.action.group(action)], dim=-1)
        values = []
        for hidden, value in zip(self.hidden, self.values, strict=True):
            fields = F.relu(hidden(x)).unflatten(-1, (-1, self._group_order))
            values.append(value(fields.amax(dim=-1)))
        return torch.cat(values, dim=-1)


def build_equivariant(config: EquivariantConfig, spec: ActorCriticSpec) -> ActorCritic:
    """Return freshly initialised modules for an action with x and y."""
    config.check_images(spec)
    if config.reflections and config.group_order < 3:
        raise ValueError("reflections need a group_order of at least 3")
    group = planar_rotations(config.group_order, has_flips=config.reflections)
    action = ActionFields(spec.action_sequence, has_reflections=config.reflections)
    pose = PoseFields(spec, has_reflections=config.reflections)
    features = [(group.regular_repr, config.n_hidden), *pose.types(group)]
    actor = EquivariantActor(_trunk(config, group, spec), features, action, pose)
    encoder: nn.Module = _trunk(config, group, spec)
    return ActorCritic(
        actor=actor,
        encoder=EquivariantEncoder(encoder, pose) if spec.vectors else encoder,
        critic=_critic(features, action, spec.critics),
        frames=Frames(action.matrices(group), _matrices(pose.types(group), group)),
    )


def _matrices(types: FieldTypes, group: PlanarGroup) -> Tensor:
    """Return the matrices [G, N, N] of the group's elements for fields that are irreps."""
    irreps = [rep.irreps[0] for rep, count in types for _ in range(count)]
    none = torch.zeros(0, 0, dtype=torch.float64, device="cpu")
    found = [
        torch.block_diag(none, *(torch.from_numpy(group.matrix(each, element)) for each in irreps))
        for element in group.elements
    ]
    return torch.stack(found).float()


def _critic(features: FieldTypes, action: ActionFields, critics: int | None) -> nn.Module:
    if critics is None:
        return EquivariantTwinCritic(features, action)
    regular, fields = features[0]
    inputs = [*features, *action.types(regular.group)]
    first = steerable_linear(inputs, [(regular, critics * fields)])
    return EnsembleCritic(first, critics, fields, regular.size, action.group)


def _trunk(config: EquivariantConfig, group: PlanarGroup, spec: ActorCriticSpec) -> ImageTrunk:
    n = config.n_hidden
    stages = trunk_stages(spec.image_size, (n / 8, n / 4, n / 2, n, 2 * n, n, n))
    divisor = round(n / stages[0][0])
    if n % divisor:
        raise ValueError(
            f"n_hidden must be a multiple of {divisor} at {spec.image_size} px, since the "
            f"first layer has n_hidden/{divisor} fields; got {n}"
        )
    regular = group.regular_repr
    fields: FieldTypes = [(group.trivial_repr, config.input_channels(spec.image_channels))]
    convs = []
    for width, padding, pools in stages:
        out = [(regular, int(width))]
        size, stride = (4, 2) if pools and config.is_strided else (3, 1)
        convs.append(SteerableConv2d(fields, out, size, padding=padding, stride=stride))
        fields = out
    pools = [  # a stride halves the image as a pool does
        pools and conv.stride == 1 for (_, _, pools), conv in zip(stages, convs, strict=True)
    ]
    return ImageTrunk(convs, pools, config, spec.image_shape)
