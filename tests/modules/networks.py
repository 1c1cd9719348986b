"""Small networks and their inputs, for the tests of all networks."""

import torch

from ba_torchrl.modules.base import NETWORKS, ActorCriticSpec
from tests.specs import close_loop_images, spatial_spec

XY, XYR, POSE = ("x", "y"), ("x", "y", "rz"), ("x", "y", "z", "rz", "ry", "rx")
SPATIAL = [
    name
    for name in NETWORKS
    if NETWORKS[name].control == "open_loop" and name != "equi_deictic_asr"
]
"""Networks that choose x, y and rz."""
COUNTS = {"rz": 8, "z": 5, "ry": 3, "rx": 3}
"""Choices of the networks in six degrees of freedom besides the pixel."""
ACTOR_CRITICS = [name for name in NETWORKS if NETWORKS[name].control == "close_loop"]
SIZES = {
    "cnn": {"width": 0.25},
    "equi": {"group_order": 4, "n_hidden": 8},
    "equi_strided": {"group_order": 4, "n_hidden": 8},
}


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def actor_critic(
    name, size=64, sequence="pxyzr", critics=None, seed=0, vectors=None, center_m=(0, 0), **fields
):
    torch.manual_seed(seed)
    config = NETWORKS[name](**{"precision": "float32", **SIZES.get(name, {}), **fields})
    images, vectors = close_loop_images(size), vectors or {}
    return config.build(ActorCriticSpec(images, sequence, critics, vectors, center_m))


def spatial(name, size=32, in_hand_size=24, channels=1, components=XYR, half=True, **fields):
    """A network; "asr/pose" is one for six degrees of freedom, "equi_asr/flatten" an option."""
    torch.manual_seed(0)
    name, *options = name.split("/")
    if "pose" in options:
        components, fields = POSE, {"num_z": 5, "num_tilts": 3, **fields}
    if "flatten" in options:
        fields = {"scene_head": "flatten", **fields}
    spec = spatial_spec(size, in_hand_size, channels, components, half)
    small = {"width": 0.125, "num_rotations": 4, "precision": "float32"}
    return NETWORKS[name](**{**small, **fields}).build(spec)


def pose(name, size=64, in_hand_size=24, half=True, **fields):
    """A network for six degrees of freedom, with the choices of `COUNTS`."""
    fields = {"num_rotations": 8, **fields}
    return spatial(f"{name}/pose", size, in_hand_size, 3, half=half, **fields)


def batch(size=32, in_hand_size=24, channels=1, n=4, seed=0):
    """Images, half of them with something held, and the choices of every level."""
    generator = torch.Generator().manual_seed(seed)
    heightmap = torch.rand(n, 1, size, size, generator=generator)
    in_hand = torch.rand(n, channels, in_hand_size, in_hand_size, generator=generator)
    limits = (size, size, 4, 4, 3, 3)
    chosen = torch.stack([torch.randint(k, (n,), generator=generator) for k in limits], dim=1)
    return heightmap, in_hand, torch.arange(n)[:, None] % 2 == 1, chosen


def pose_batch(size=64, in_hand_size=24, n=4, seed=0):
    """Rough heightmaps with blocks of many heights, projections, and choices within `COUNTS`."""
    generator = torch.Generator().manual_seed(seed)
    coarse = 0.15 * torch.rand(n, 1, size // 4, size // 4, generator=generator)
    in_hand = torch.randint(24, (n, 3, in_hand_size, in_hand_size), generator=generator).float()
    limits = (size, size, *COUNTS.values())
    chosen = torch.stack([torch.randint(k, (n,), generator=generator) for k in limits], dim=1)
    heightmap = coarse.repeat_interleave(4, -1).repeat_interleave(4, -2)
    return heightmap, in_hand, torch.arange(n)[:, None] % 2 == 1, chosen


def values_of(network, heightmap, in_hand, holding, chosen):
    """The Q values of all levels."""
    first, state = network.first(heightmap, in_hand, holding)
    later = range(1, len(network.levels))
    return [first, *(network.later(n, state, chosen[:, : n + 1]) for n in later)]


def train(network, make_batch=batch, steps=4):
    """Take a few optimiser steps towards random targets, so that biases are not zero."""
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    before = [parameter.detach().clone() for parameter in network.parameters()]
    for step in range(steps):
        values = values_of(network, *make_batch(seed=step + 10))
        loss = sum((q - torch.rand_like(q)).square().mean() for q in values)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert all(not torch.equal(p, q) for p, q in zip(network.parameters(), before, strict=True))


def turned_pixels(chosen, size, quarters=1):
    """Pixels [n, 2] after quarter turns by torch.rot90, found in a rotated image."""
    numbers = torch.arange(size * size).reshape(size, size)
    position = torch.empty(size * size, dtype=torch.long)
    position[torch.rot90(numbers, quarters).flatten()] = torch.arange(size * size)
    moved = position[chosen[:, 0] * size + chosen[:, 1]]
    return torch.stack([moved // size, moved % size], dim=1)
