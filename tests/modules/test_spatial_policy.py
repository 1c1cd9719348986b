import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.core.errors import BatchError
from ba_torchrl.modules.spatial.base import Level, SpatialQNetwork
from ba_torchrl.modules.spatial.policy import (
    SpatialActions,
    SpatialPolicy,
    SpatialValues,
    spatial_policy,
)
from ba_torchrl.sim.geometry import euler_matrix

BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
PIXELS = Level(("x", "y"), (6, 8))
YAWS = Level(("rz",), (4,))
VOLUME = Level(("rz", "x", "y"), (4, 6, 8))


def layout(sequence="pxyr", levels=(PIXELS, YAWS), half_rotation=True):
    return SpatialActions(OpenLoopActions(sequence, BOUNDS, half_rotation), levels)


class Table(SpatialQNetwork):
    """A network with values from tables; those of the second level depend on the chosen pixel."""

    levels = (PIXELS, YAWS)

    def __init__(self, seed=0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.pixels = nn.Parameter(torch.rand(2, 6, 8, generator=generator))
        self.yaws = nn.Parameter(torch.rand(2, 6, 8, 4, generator=generator))

    def first(self, heightmap, in_hand, holding):
        primitive = holding[:, 0].long()
        return self.pixels[primitive] + 0 * heightmap.mean(), primitive

    def later(self, level, state, chosen):
        assert level == 1
        return self.yaws[state, chosen[:, 0], chosen[:, 1]]


def observation(count, holding=None):
    flags = torch.zeros(count, 1, dtype=torch.bool) if holding is None else holding
    return torch.zeros(count, 1, 6, 8), torch.zeros(count, 1, 4, 4), flags


@pytest.mark.parametrize("half_rotation", [True, False])
@pytest.mark.parametrize("sequence", ["pxyr", "rxy", "ypxr"])
@pytest.mark.parametrize("levels", [(PIXELS, YAWS), (VOLUME,)], ids=["asr", "fcn"])
def test_indices_and_actions_are_converted_both_ways(sequence, levels, half_rotation):
    actions = layout(sequence, levels, half_rotation)
    shapes = [size for level in levels for size in level.shape]
    every = torch.tensor(list(itertools.product(*map(range, shapes))))
    action = actions.to_action(every, torch.zeros(len(every), 1, dtype=torch.bool))
    assert action.dtype == torch.float32
    assert torch.equal(actions.to_indices(action), every)
    assert len(action.unique(dim=0)) == len(every)
    for level in range(len(levels)):
        assert torch.equal(
            actions.unravel(actions.ravel(every, level), level), actions.at_level(every, level)
        )
    assert torch.equal(actions.ravel(every, 0).unique(), torch.arange(math.prod(levels[0].shape)))


def test_an_index_is_the_centre_of_its_pixel():
    actions = layout()
    action = actions.to_action(
        torch.tensor([[0, 0, 0], [5, 7, 3]]), torch.tensor([[False], [True]])
    )
    step_x, step_y = 0.4 / 6, 0.4 / 8
    expected = [
        [0, 0.25 + step_x / 2, -0.2 + step_y / 2, 0],
        [1, 0.65 - step_x / 2, 0.2 - step_y / 2, 3 * math.pi / 4],
    ]
    torch.testing.assert_close(action, torch.tensor(expected), atol=1e-7, rtol=0)


def test_an_action_is_converted_to_the_nearest_pixel_and_yaw():
    actions = layout()
    low = torch.tensor([0.0, 0.25, -0.2, 0.0])
    corner = torch.tensor([0.0, 0.65, 0.2, 0.0])
    just_before = torch.tensor([0.0, 0.25 + 0.4 / 6 - 1e-4, -0.2 + 0.4 / 8 + 1e-4, 0.0])
    assert actions.to_indices(low).tolist() == [0, 0, 0]
    assert actions.to_indices(corner).tolist() == [5, 7, 0]
    assert actions.to_indices(just_before).tolist() == [0, 1, 0]
    step = math.pi / 4
    for yaw, index in [(0.4 * step, 0), (0.6 * step, 1), (3.4 * step, 3), (3.6 * step, 0)]:
        assert actions.to_indices(torch.tensor([0.0, 0.4, 0.0, yaw]))[2] == index
    full = layout(half_rotation=False)  # the same steps now span a whole turn
    assert full.to_indices(torch.tensor([0.0, 0.4, 0.0, math.pi]))[2] == 2


def test_levels_must_have_the_components_of_the_action():
    with pytest.raises(ValueError, match="chooses x, y, rz; the action sequence 'pxy' has x, y"):
        layout("pxy")


SIX = (
    PIXELS,
    YAWS,
    *(Level((name,), (count,)) for name, count in [("z", 5), ("ry", 7), ("rx", 3)]),
)
LIMITS = {"z": (0.02, 0.2), "ry": (-0.3, 0.3), "rx": (-0.4, 0.4)}


def six(half_rotation=True, sequence="pxyzrrr"):
    return SpatialActions(OpenLoopActions(sequence, BOUNDS, half_rotation), SIX, LIMITS)


@pytest.mark.parametrize("half_rotation", [True, False])
@pytest.mark.parametrize("sequence", ["pxyzrrr", "rzrpyxr"])
def test_indices_of_six_degrees_of_freedom_are_converted_both_ways(sequence, half_rotation):
    actions = six(half_rotation, sequence)
    every = torch.tensor(list(itertools.product(*(range(axis.count) for axis in actions.axes))))
    action = actions.to_action(every, torch.ones(len(every), 1, dtype=torch.bool))
    assert torch.equal(actions.to_indices(action), every)
    assert torch.equal(actions.nearest(action), action)
    named = dict(zip(actions.actions.components, action.T, strict=True))
    assert (named["p"] == 1).all()
    for name, count in (("z", 5), ("ry", 7), ("rx", 3)):
        values = torch.linspace(*LIMITS[name], count)
        torch.testing.assert_close(named[name].unique(), values, atol=1e-6, rtol=0)


def tool(action):
    return torch.tensor(euler_matrix(*action[4:].tolist()), dtype=torch.float64)


def test_a_yaw_close_to_half_a_turn_negates_the_tilts():
    """The nearest grid action is then half a turn about the tool's own axis from the action."""
    actions = six()
    over = torch.tensor([0.0, 0.4, 0.0, 0.065, math.pi - 0.01, 0.2, -0.4])
    assert actions.to_indices(over)[2:].tolist() == [0, 1, 1, 2]
    near = actions.nearest(over)
    expected = torch.tensor([0.0, near[1], near[2], 0.065, 0.0, -0.2, 0.4])
    torch.testing.assert_close(near, expected, atol=1e-6, rtol=0)
    swap = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(tool(near), tool(over) @ swap, atol=0.011, rtol=0)
    unwrapped = over.clone()
    unwrapped[4] -= math.pi / 4 * 0.6
    assert actions.to_indices(unwrapped)[2:].tolist() == [3, 1, 5, 0]


def test_a_yaw_close_to_a_whole_turn_keeps_the_tilts():
    actions = six(half_rotation=False)
    over = torch.tensor([0.0, 0.4, 0.0, 0.065, 2 * math.pi - 0.01, 0.2, -0.4])
    assert actions.to_indices(over)[2:].tolist() == [0, 1, 5, 0]


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"z": (0.0, 0.2)}, r"grid of z must increase within \[0.01, 0.25\], got \[0, 0.2\]"),
        ({"z": (0.2, 0.02)}, "grid of z must increase"),
        ({"ry": (-0.3, 2.0)}, "grid of ry must increase within"),
        ({"rz": (0.0, 1.0)}, "grid of rz spans its whole range"),
    ],
)
def test_grids_outside_the_bounds_of_the_action_are_refused(limits, message):
    with pytest.raises(ValueError, match=message):
        SpatialActions(OpenLoopActions("pxyzrrr", BOUNDS), SIX, limits)


def test_a_grid_of_z_without_limits_spans_the_bounds():
    axis = OpenLoopActions("pxyzrrr", BOUNDS).axis("z", 5)
    assert (axis.first, axis.first + 4 * axis.step) == pytest.approx((0.01, 0.25))


def test_greedy_chooses_the_best_pixel_and_then_its_best_yaw():
    network = Table()
    values = SpatialValues(network, layout())
    holding = torch.tensor([[False], [True]])
    chosen, value = values.greedy(*observation(2, holding))
    for primitive in (0, 1):
        best = int(network.pixels[primitive].argmax())
        row, column = divmod(best, 8)
        yaw = int(network.yaws[primitive, row, column].argmax())
        assert chosen[primitive].tolist() == [row, column, yaw]
        assert value[primitive, 0] == network.yaws[primitive, row, column, yaw]


@pytest.mark.parametrize("shape", [(2, 6, 8), (2, 1, 8, 6), (2, 6, 8, 1), (2, 1, 12, 16)])
def test_heightmaps_of_another_shape_than_the_grid_are_refused(shape):
    _, in_hand, holding = observation(2)
    with pytest.raises(BatchError, match=r"'heightmap' is .* end in \[1, 6, 8\]"):
        SpatialValues(Table(), layout()).greedy(torch.zeros(shape), in_hand, holding)


def test_later_levels_are_conditioned_on_the_choices_of_the_action():
    network = Table()
    actions = layout()
    values = SpatialValues(network, actions)
    holding = torch.tensor([[True], [False]])
    indices = torch.tensor([[2, 3, 1], [5, 0, 3]])
    first, later = values(*observation(2, holding), actions.to_action(indices, holding))
    assert first[1].tolist() == [2 * 8 + 3, 5 * 8]
    assert later[1].tolist() == [1, 3]
    assert torch.equal(first[0][0], network.pixels[1].flatten())
    assert torch.equal(later[0], torch.stack([network.yaws[1, 2, 3], network.yaws[0, 5, 0]]))


def policy(epsilon=0.0, seed=0):
    made = SpatialPolicy(SpatialValues(Table(), layout()), seed)
    made.epsilon.fill_(epsilon)
    return made


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
def test_the_policy_writes_only_the_action_for_any_batch_shape(shape):
    state = TensorDict(
        {
            "heightmap": torch.zeros(*shape, 1, 6, 8),
            "in_hand": torch.zeros(*shape, 1, 4, 4),
            "holding": torch.ones(*shape, 1, dtype=torch.bool),
        },
        batch_size=shape,
    )
    out = spatial_policy(policy())(state)
    assert set(out.keys()) == {"heightmap", "in_hand", "holding", "action"}
    assert out["action"].shape == (*shape, 4)
    assert (out["action"][..., 0] == 1).all()


def test_exploration_chooses_pixels_of_objects_and_keeps_the_primitive():
    heightmap, in_hand, holding = observation(4000)
    heightmap[:, 0, 2, 3] = heightmap[:, 0, 4, 5] = 0.03
    holding[::2] = True
    explorer = policy(epsilon=0.75)
    with set_exploration_type(ExplorationType.RANDOM):
        action = explorer(heightmap, in_hand, holding)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = explorer(heightmap, in_hand, holding)
    assert torch.equal(action[:, 0], holding[:, 0].float())
    same = (action == greedy).all(dim=1)
    assert abs(float(same.float().mean()) - 0.25) < 0.03
    found = layout().to_indices(action[~same])
    spots = {tuple(pair) for pair in found[:, :2].tolist()}
    assert spots == {(2, 3), (4, 5)}
    share = torch.bincount(found[:, 2], minlength=4) / len(found)
    assert (share - 0.25).abs().max() < 0.04


def test_exploration_of_an_empty_scene_is_uniform_and_reproducible():
    results = []
    for seed in (0, 0, 1):
        with set_exploration_type(ExplorationType.RANDOM):
            results.append(policy(epsilon=1.0, seed=seed)(*observation(2000)))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])
    assert len(layout().to_indices(results[0])[:, :2].unique(dim=0)) == 48
