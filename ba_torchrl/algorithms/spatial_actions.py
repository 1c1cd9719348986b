"""Spatial Q networks, and demonstrations on their grid of actions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase

from ba_torchrl.algorithms.base import Problem
from ba_torchrl.core import keys
from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.config import NetworkConfig
from ba_torchrl.modules.spatial.base import SpatialSpec
from ba_torchrl.modules.spatial.policy import SpatialActions, SpatialValues


def make_spatial_values(
    network: NetworkConfig, problem: Problem, images: Mapping[str, ImageSpec]
) -> SpatialValues:
    """Return a freshly initialised network, wrapped as values of the environment's actions."""
    actions = problem.actions
    assert isinstance(actions, OpenLoopActions), "spatial networks are for open_loop tasks"
    spec = SpatialSpec(
        images,
        components=tuple(name for name in actions.components if name != "p"),
        half_rotation=actions.half_rotation,
        side_m=actions.bounds_m[0][1] - actions.bounds_m[0][0],
    )
    net = network.build(spec)
    values = SpatialValues(net, SpatialActions(actions, net.levels, net.limits), list(images))
    return values.to(problem.device)


def demonstration_on_grid(
    episode: TensorDictBase, grid: SpatialActions, images: Mapping[str, ImageSpec]
) -> TensorDictBase:
    """Return an episode [T] with the nearest actions on the grid.

    If the nearest yaw of a pick close to half a turn is zero, the fingers are swapped, and the
    images with the gripper's axes are reversed while the picked object is held.
    """
    action = episode[keys.ACTION]
    out = episode.copy().set(keys.ACTION, grid.nearest(action))
    for key in (keys.EXPERT_ACTION, keys.EXPERT_MOVES):
        if key in episode:
            out.set(key, grid.nearest(episode[key]))
    is_swapped = grid.swaps_fingers(action)
    is_over = torch.zeros(len(episode) + 1, dtype=torch.bool, device="cpu")
    for t, is_holding in enumerate(episode[keys.HOLDING].flatten().tolist()):
        is_over[t + 1] = is_over[t] if is_holding else is_swapped[t]
    for key, image in images.items():
        if image.frame == "gripper":
            for nested, over in ((key, is_over[:-1]), ((keys.NEXT, key), is_over[1:])):
                reversed_images = image.reverse_axes(episode[nested], "xy")
                over = over.reshape(-1, 1, 1, 1)
                out.set(nested, torch.where(over, reversed_images, episode[nested]))
    return out
