"""The losses on five levels of choices, compared with loops over samples, levels and choices."""

import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.modules.spatial.base import Level, SpatialQNetwork
from ba_torchrl.modules.spatial.policy import SpatialActions, SpatialValues
from ba_torchrl.objectives.dqn import LevelDQNLoss

GAMMA = 0.9
BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
COUNTS = (3, 3, 4, 5, 3, 2)
"""Rows, columns, yaws, z, ry, rx."""
LEVELS = (
    Level(("x", "y"), COUNTS[:2]),
    *(Level((name,), (n,)) for name, n in zip(("rz", "z", "ry", "rx"), COUNTS[2:], strict=True)),
)


class Tables(SpatialQNetwork):
    """Values from tables over all choices so far, times the mean of the image."""

    levels = LEVELS

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.tables = nn.ParameterList(
            torch.randn(2, *COUNTS[: n + 2], generator=generator) for n in range(5)
        )

    def first(self, pixels, in_hand, holding):
        state = holding[:, 0].long(), pixels.mean(dim=(1, 2, 3))
        return self.tables[0][state[0]] * state[1][:, None, None], state

    def later(self, level, state, chosen):
        primitive, scale = state
        return self.tables[level][(primitive, *chosen.unbind(1))] * scale[:, None]


def batch(size=10, experts="some", seed=0):
    generator = torch.Generator().manual_seed(seed)
    flags = torch.rand(size, 1, generator=generator) < 0.5
    flags = {"some": flags, "all": torch.ones_like(flags), "none": torch.zeros_like(flags)}[experts]
    ends = torch.rand(2, size, 1, generator=generator) < 0.3
    chosen = torch.stack([torch.randint(n, (size,), generator=generator) for n in COUNTS], dim=1)

    def state():
        return {
            "pixels": torch.rand(size, 1, 3, 3, generator=generator) + 0.5,
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
    return data, chosen.tolist()


ACTIONS = SpatialActions(OpenLoopActions("pxyzrrr", BOUNDS), LEVELS)


def make_loss(kind):
    values = SpatialValues(Tables(), ACTIONS)
    loss = LevelDQNLoss(values, demonstrations=kind, demonstration_weight=0.2, margin=0.3)
    loss = loss.make_value_estimator(gamma=GAMMA)
    with torch.no_grad():  # a target that differs from the network
        for value in loss.target_value_network_params.values(True, True):
            value.add_(0.5 * torch.randn(value.shape, generator=torch.Generator().manual_seed(5)))
    return loss


def lookup(params, level, state, index, chosen):
    """Return {choice: value} of a level, given the choices before it."""
    table = params["network", "tables", str(level)].detach().double()
    scale = float(state["pixels"][index].double().mean())
    row = table[int(state["holding"][index])]
    for choice in chosen:
        row = row[choice]
    sizes = COUNTS[:2] if level == 0 else (COUNTS[level + 1],)
    return {choice: float(row[choice]) * scale for choice in itertools.product(*map(range, sizes))}


def demonstration_term(kind, q, taken, level):
    if kind == "sdqfd":
        gaps = [v - q[taken] + 0.3 for a, v in q.items() if a != taken and v > q[taken] - 0.3]
        return sum(gaps) / len(gaps) if gaps else 0.0
    if kind == "dqfd":
        return max(v + 0.3 * (a != taken) for a, v in q.items()) - q[taken]
    beta = 100.0 if level == 0 else 1.0
    top = max(q.values())
    total = sum(math.exp(beta * (v - top)) for v in q.values())
    return beta * (top - q[taken]) + math.log(total)


@pytest.mark.parametrize("experts", ["some", "all", "none"])
@pytest.mark.parametrize("kind", ["none", "dqfd", "sdqfd", "adet"])
def test_the_losses_of_five_levels_equal_loops(kind, experts):
    data, chosen = batch(experts=experts)
    loss = make_loss(kind)
    td, term, priorities = 0.0, 0.0, []
    for i, choices in enumerate(chosen):
        greedy = ()
        for level in range(5):  # the target's choices, each given those before
            following = lookup(loss.target_value_network_params, level, data["next"], i, greedy)
            best = max(following, key=following.get)
            greedy += best
        alive = not data["next", "terminated"][i]
        y = float(data["next", "reward"][i]) + GAMMA * alive * following[best]
        errors = []
        for level in range(5):  # the stored choices, each given those before
            before = choices[: level + 1] if level else []
            q = lookup(loss.value_network_params, level, data, i, before)
            taken = tuple(choices[:2]) if level == 0 else (choices[level + 1],)
            errors.append(abs(q[taken] - y))
            td += 0.5 * errors[-1] ** 2 if errors[-1] < 1 else errors[-1] - 0.5
            if data["is_demonstration"][i] and kind != "none":
                term += demonstration_term(kind, q, taken, level)
        priorities.append(sum(errors) / 5)
    count = len(data) if kind == "sdqfd" else max(int(data["is_demonstration"].sum()), 1)
    out = loss(data)
    assert float(out["loss_qvalue"].detach()) == pytest.approx(td / len(data), rel=1e-5)
    assert float(out["loss_demonstration"].detach()) == pytest.approx(0.2 * term / count, rel=1e-4)
    assert data["td_error"].squeeze(-1).tolist() == pytest.approx(priorities, rel=1e-5)
    (out["loss_qvalue"] + out["loss_demonstration"]).backward()
    assert all(parameter.grad.any() for parameter in loss.parameters())
