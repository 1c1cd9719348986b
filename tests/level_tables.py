"""Values of the levels of a six-dimensional action, from tables, and a batch for them."""

import torch
from tensordict import TensorDict
from torch import nn

from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.modules.spatial.base import Level, SpatialQNetwork
from ba_torchrl.modules.spatial.policy import SpatialActions

BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
COUNTS = (3, 3, 4, 5, 3, 2)
"""Rows, columns, yaws, z, ry, rx."""
LEVELS = (
    Level(("x", "y"), COUNTS[:2]),
    *(Level((name,), (n,)) for name, n in zip(("rz", "z", "ry", "rx"), COUNTS[2:], strict=True)),
)
ACTIONS = SpatialActions(OpenLoopActions("pxyzrrr", BOUNDS), LEVELS)


class Tables(SpatialQNetwork):
    """Values from tables over all choices so far, times the mean of the image."""

    levels = LEVELS

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.tables = nn.ParameterList(
            torch.randn(2, *COUNTS[: n + 2], generator=generator) for n in range(5)
        )

    def reset_parameters(self):
        for table in self.tables:
            nn.init.normal_(table)

    def first(self, heightmap, in_hand, holding):
        state = holding[:, 0].long(), heightmap.mean(dim=(1, 2, 3))
        return self.tables[0][state[0]] * state[1][:, None, None], state

    def later(self, level, state, chosen):
        primitive, scale = state
        return self.tables[level][(primitive, *chosen.unbind(1))] * scale[:, None]


def batch(size=10, experts="some", seed=0):
    """Random transitions, with the indices of their actions under "chosen"."""
    generator = torch.Generator().manual_seed(seed)
    flags = torch.rand(size, 1, generator=generator) < 0.5
    flags = {"some": flags, "all": torch.ones_like(flags), "none": torch.zeros_like(flags)}[experts]
    ends = torch.rand(2, size, 1, generator=generator) < 0.3
    chosen = torch.stack([torch.randint(n, (size,), generator=generator) for n in COUNTS], dim=1)

    def state():
        return {
            "heightmap": torch.rand(size, 1, 3, 3, generator=generator) + 0.5,
            "in_hand": torch.zeros(size, 1, 4, 4),
            "holding": torch.rand(size, 1, generator=generator) < 0.5,
        }

    following = {
        "reward": torch.rand(size, 1, generator=generator),
        "terminated": ends[0],
        "truncated": ends[1] & ~ends[0],
        "done": ends[0] | ends[1],
    }
    data = TensorDict(
        {**state(), "is_demonstration": flags, "next": {**state(), **following}}, batch_size=[size]
    )
    data["action"] = ACTIONS.to_action(chosen, data["holding"])
    return data.set("chosen", chosen)
