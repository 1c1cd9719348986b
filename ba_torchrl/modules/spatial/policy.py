"""Policies on spatial Q values, with actions in the environment's units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from ba_torchrl.core import keys
from ba_torchrl.core.actions import PLACE, TILTS, GridAxis, OpenLoopActions
from ba_torchrl.core.errors import BatchError
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.modules.layers import check_image, widened, widest_float
from ba_torchrl.modules.spatial.base import Level, SpatialQNetwork

OBJECT_HEIGHT_M = 0.01
"""Random actions choose among the pixels higher than this, if there are any."""


class SpatialActions:
    """Converts between a spatial network's choices and the actions on its grid.

    Indices of x and y are rows and columns of the heightmap. The action is the centre of the pixel,
    in the reference implementation its corner.

    Args:
        actions: the environment's action vector.
        levels: the levels of choices, in their order.
        limits: first and last value on the grids of z and the tilts, see `OpenLoopActions.axis`.
    """

    def __init__(
        self,
        actions: OpenLoopActions,
        levels: Sequence[Level],
        limits: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        self.actions = actions
        self.levels = tuple(levels)
        self.components = chosen = [name for level in levels for name in level.components]
        wanted = [name for name in actions.components if name != "p"]
        if sorted(chosen) != sorted(wanted):
            raise ValueError(
                f"the network chooses {', '.join(chosen)}; the action sequence "
                f"{actions.sequence!r} has {', '.join(wanted)}"
            )
        self.axes = [
            actions.axis(name, count, limits.get(name))
            for level in levels
            for name, count in zip(level.components, level.shape, strict=True)
        ]
        self._positions = [actions.components.index(name) for name in chosen]
        ends = torch.tensor([len(level.shape) for level in levels], device="cpu").cumsum(0).tolist()
        self._parts = [
            slice(end - len(level.shape), end) for end, level in zip(ends, levels, strict=True)
        ]

    def to_action(self, indices: Tensor, holding: Tensor) -> Tensor:
        """Return the actions [..., A] of indices: picks where nothing is held, else places.

        Args:
            indices: int64 [..., n], of the components of all levels in their order.
            holding: [..., 1], true where something is held.
        """
        shape = (*indices.shape[:-1], self.actions.size)
        # computed in float64, so that the result is the nearest float32 on any device that has it
        dtype = widest_float(indices.device)
        action = torch.zeros(shape, dtype=dtype, device=indices.device)
        for i, (place, axis) in enumerate(zip(self._positions, self.axes, strict=True)):
            action[..., place] = axis.first + axis.step * widened(indices[..., i])
        if "p" in self.actions.components:
            primitive = self.actions.components.index("p")
            action[..., primitive] = PLACE * widened(holding[..., 0])
        return action.float()

    def to_indices(self, action: Tensor) -> Tensor:
        """Return the nearest indices, int64 [..., n], of actions [..., A].

        Where the yaw of the nearest index is half a turn from the nearest yaw, the fingers are
        swapped, and the tilts are negated: except for the fingers, the tool keeps its pose.
        """
        if action.shape[-1] != self.actions.size:
            raise BatchError(
                f"the actions have shape {list(action.shape)}, and need {self.actions.size} "
                f"components, one per letter of {self.actions.sequence!r}"
            )
        is_swapped = self.swaps_fingers(action)
        columns = []
        for name, place, axis in zip(self.components, self._positions, self.axes, strict=True):
            value = widened(action[..., place])
            if name in TILTS:
                value = torch.where(is_swapped, -value, value)
            index = _nearest_step(value, axis)
            if axis.period is None:
                index = index.clamp(0, axis.count - 1)
            else:
                index = index.remainder(axis.count)
            columns.append(index)
        return torch.stack(columns, dim=-1)

    def swaps_fingers(self, action: Tensor) -> Tensor:
        """Return whether the choices nearest to actions [..., A] swap the fingers, bool [...]."""
        if "rz" not in self.components or not self.actions.half_rotation:
            return torch.zeros(action.shape[:-1], dtype=torch.bool, device=action.device)
        rz = self.components.index("rz")
        step = _nearest_step(widened(action[..., self._positions[rz]]), self.axes[rz])
        return step.div(self.axes[rz].count, rounding_mode="floor").remainder(2) == 1

    def nearest(self, action: Tensor) -> Tensor:
        """Return the grid actions nearest to actions [..., A]; the primitive is unchanged."""
        indices, out = self.to_indices(action), action.clone()
        for i, (place, axis) in enumerate(zip(self._positions, self.axes, strict=True)):
            out[..., place] = (axis.first + axis.step * widened(indices[..., i])).to(out)
        return out

    def at_level(self, indices: Tensor, level: int) -> Tensor:
        """Return one level's part of the indices [..., n]."""
        return indices[..., self._parts[level]]

    def before(self, indices: Tensor, level: int) -> Tensor:
        """Return the part of the indices [..., n] that belongs to the levels before one."""
        return indices[..., : self._parts[level].start]

    def ravel(self, indices: Tensor, level: int) -> Tensor:
        """Return one level's choice [...] as an index into its flattened values."""
        flat = torch.zeros_like(indices[..., 0])
        for index, size in zip(
            self.at_level(indices, level).unbind(-1), self.levels[level].shape, strict=True
        ):
            flat = flat * size + index
        return flat

    def unravel(self, flat: Tensor, level: int) -> Tensor:
        """Return the indices [..., m] of a choice [...] among a level's flattened values."""
        indices = []
        for size in reversed(self.levels[level].shape):  # `unravel_index` copies from the host
            indices.append(flat.remainder(size))
            flat = flat.div(size, rounding_mode="floor")
        return torch.stack(indices[::-1], dim=-1)


def _nearest_step(values: Tensor, axis: GridAxis) -> Tensor:
    """Return the nearest int64 numbers of steps from an axis' first value, not wrapped."""
    return ((values - axis.first) / axis.step).round().long()


class SpatialValues(nn.Module):
    """Values of actions in the environment's units, level by level.

    They are the `LevelValues` of losses (`ba_torchrl.objectives.dqn`).

    Args:
        network: computes the values of its choices.
        actions: the bijection between its choices and the environment's actions.
        image_keys: keys of the network's input images, in the order of its arguments.
    """

    action_dims = 1
    """Number of dimensions of an action, a vector."""

    def __init__(
        self,
        network: SpatialQNetwork,
        actions: SpatialActions,
        image_keys: Sequence[str] = (keys.HEIGHTMAP, keys.IN_HAND),
    ) -> None:
        super().__init__()
        self.network = network
        self.actions = actions
        self.in_keys = [*image_keys, keys.HOLDING]

    def _first(self, heightmap: Tensor, *others: Tensor) -> tuple[Tensor, Any]:
        """Return the values of the network's first level, and its state."""
        counts = dict(zip(self.actions.components, self.actions.axes, strict=True))
        check_image(self.in_keys[0], heightmap, (1, counts["x"].count, counts["y"].count))
        return self.network.first(heightmap, *others)

    def greedy(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the greedy choices, level after level, and the last level's value.

        Args:
            observation: the images [B, C, H, W] each, and the holding flag [B, 1].

        Returns:
            int64 [B, n] and float32 [B, 1].
        """
        q, state = self._first(*observation)
        value, best = q.flatten(1).max(dim=1, keepdim=True)
        chosen = self.actions.unravel(best[:, 0], 0)
        for level in range(1, len(self.actions.levels)):
            q = self.network.later(level, state, chosen)
            value, best = q.flatten(1).max(dim=1, keepdim=True)
            chosen = torch.cat([chosen, self.actions.unravel(best[:, 0], level)], dim=-1)
        return chosen, value

    def value_of(self, *observation_and_choices: Tensor) -> Tensor:
        """Return the last level's value, float32 [B, 1], of given choices.

        Args:
            observation_and_choices: the images [B, C, H, W] each, the holding flag [B, 1] and the
                choices, int64 [B, n].
        """
        *observation, chosen = observation_and_choices
        q, state = self._first(*observation)
        last = len(self.actions.levels) - 1
        if last:
            q = self.network.later(last, state, self.actions.before(chosen, last))
        return q.flatten(1).gather(1, self.actions.ravel(chosen, last)[:, None])

    def forward(self, *observation_and_action: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values of every level, given the action's choices at the levels before.

        Args:
            observation_and_action: the images [B, C, H, W] each, the holding flag [B, 1] and the
                action [B, A].

        Returns:
            For each level the values of all its choices [B, N], and the action's choice [B].
        """
        *observation, action = observation_and_action
        indices = self.actions.to_indices(action)
        q, state = self._first(*observation)
        found = [(q.flatten(1), self.actions.ravel(indices, 0))]
        for level in range(1, len(self.actions.levels)):
            q = self.network.later(level, state, self.actions.before(indices, level))
            found.append((q.flatten(1), self.actions.ravel(indices, level)))
        return found

    def of_moves(self, *observation_and_moves: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the values of every level, and which choices lead to any of several actions.

        The values of a level, and the actions that count there, are those after the choice of the
        greatest value among the actions at each level before.

        Args:
            observation_and_moves: the images [B, C, H, W] each, the holding flag [B, 1] and the
                actions [B, K, A].

        Returns:
            For each level the values of all its choices [B, N], and bool [B, N].
        """
        *observation, moves = observation_and_moves
        indices = self.actions.to_indices(moves)
        counts = torch.ones(indices.shape[:2], dtype=torch.bool, device=indices.device)
        chosen = indices[:, 0]
        q, state = self._first(*observation)
        found: list[tuple[Tensor, Tensor]] = []
        for level in range(len(self.actions.levels)):
            if level:
                q = self.network.later(level, state, self.actions.before(chosen, level))
            values, flat = q.flatten(1), self.actions.ravel(indices, level)
            times = torch.zeros_like(values).scatter_add_(1, flat, counts.to(values))
            found.append((values, times > 0))
            own = values.detach().gather(1, flat).masked_fill(~counts, -math.inf)
            best = own.argmax(dim=1, keepdim=True)
            counts = counts & (flat == flat.gather(1, best))
            chosen = indices.take_along_dim(best[:, :, None], dim=1)[:, 0]
        return found


class SpatialPolicy(nn.Module):
    """Epsilon-greedy policy on spatial Q values.

    A random action has random angles and a random pixel of an object, if there is one.
    TorchRL's ``EGreedyModule`` would also draw the primitive, which the state determines. As in
    TorchRL, the policy explores under the exploration type RANDOM only.

    Args:
        values: of the actions; the first image is the heightmap.
        seed: of random actions.
    """

    epsilon: Tensor

    def __init__(self, values: SpatialValues, seed: int) -> None:
        super().__init__()
        self.values = values
        self.register_buffer("epsilon", torch.zeros(()))
        self.generator = seeded_generator(seed)

    @torch.no_grad()
    def forward(self, *observation: Tensor) -> Tensor:
        """Return actions [..., A].

        Args:
            observation: the images [..., C, H, W] each, and the holding flag [..., 1].
        """
        *images, holding = observation
        leading = holding.shape[:-1]
        count = math.prod(leading)
        images = [image.reshape(count, *image.shape[-3:]) for image in images]
        holding = holding.reshape(count, 1)
        indices, _ = self.values.greedy(*images, holding)
        if exploration_type() == ExplorationType.RANDOM and self.epsilon > 0:
            explores = (
                torch.rand(count, generator=self.generator, device="cpu", dtype=torch.float32)
                < self.epsilon.cpu()
            )
            random = self._random_indices(images[0]).to(indices.device)
            indices = torch.where(explores.to(indices.device)[:, None], random, indices)
        return self.values.actions.to_action(indices, holding).reshape(*leading, -1)

    def _random_indices(self, heightmap: Tensor) -> Tensor:
        """Return random choices, int64 [B, n]."""
        actions = self.values.actions
        count, width = len(heightmap), heightmap.shape[-1]
        weights = (heightmap[:, 0] > OBJECT_HEIGHT_M).flatten(1).float().cpu()
        weights[weights.sum(dim=1) == 0] = 1.0
        pixel = torch.multinomial(weights, 1, generator=self.generator)[:, 0]
        columns = {"x": pixel // width, "y": pixel % width}
        for name, axis in zip(actions.components, actions.axes, strict=True):
            if name not in columns:
                columns[name] = torch.randint(
                    axis.count, (count,), generator=self.generator, device="cpu"
                )
        return torch.stack([columns[name] for name in actions.components], dim=-1)


def spatial_policy(policy: SpatialPolicy) -> TensorDictModule:
    """Return a spatial policy as a TensorDict module, from the observation to ``action``."""
    return TensorDictModule(policy, in_keys=policy.values.in_keys, out_keys=[keys.ACTION])
