"""Bin packing, bottles and boxes: exact goals, boxes that come one by one, and the experts."""

import itertools
import math

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.actions import PLACE
from ba_torchrl.errors import ConfigError, PlacementError
from ba_torchrl.sim.geometry import yaw_quaternion
from ba_torchrl.sim.meshes import lathe_parts
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.footprints import Rectangle, gap_m, narrowest
from ba_torchrl.tasks.open_loop.bin_packing import BIN_M, pieces
from ba_torchrl.tasks.open_loop.bottle_arrangement import BOTTLES_CM
from ba_torchrl.tasks.open_loop.bottle_arrangement import slots as bottle_slots
from ba_torchrl.tasks.open_loop.box_palletizing import BOX_M, PALLET_M, SLOT_M, slots
from ba_torchrl.tasks.packing.base import open_box
from ba_torchrl.tasks.packing.layout import Footprint, scatter
from ba_torchrl.tasks.workspace import Workspace

BIN, BOTTLES, BOXES = (
    f"open_loop/{name}" for name in ("bin_packing", "bottle_arrangement", "box_palletizing")
)
TURNED = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
"""A quarter turn about x."""


@pytest.fixture
def make():
    made = []

    def build(task, **config):
        env = ba_torchrl.make(task, **{"obs_size": 32, "seed": 0, "expert": True, **config})
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()


def follow(env, state, steps=100):
    """Let the expert act; return what followed."""
    seen = []
    for _ in range(steps):
        state = env.step(state.clone().set("action", state["expert_action"]))["next"]
        seen.append(state)
        if state["done"]:
            break
    return seen


# -- rectangles --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("second", "gap"),
    [
        (Rectangle(0.5, 0.0, 0.0, 0.1, 0.1), 0.2),
        (Rectangle(0.0, -0.4, 0.0, 0.1, 0.1), 0.2),
        (Rectangle(0.35, 0.0, math.pi / 2, 0.05, 0.1), 0.05),
        (Rectangle(0.25, 0.0, 0.0, 0.1, 0.1), -0.05),
        (Rectangle(0.0, 0.0, 0.3, 0.01, 0.01), None),
    ],
)
def test_gaps_between_rectangles(second, gap):
    first = Rectangle(0.0, 0.0, 0.0, 0.2, 0.1)
    for yaw in (0.0, 0.7):  # turned together, nothing changes
        a = first._replace(yaw_rad=yaw)
        x, y = a.frame.to_world(second.x, second.y)
        b = second._replace(x=x, y=y, yaw_rad=second.yaw_rad + yaw)
        assert gap_m(a, b) == pytest.approx(gap_m(b, a))
        if gap is None:
            assert gap_m(a, b) < 0
        else:
            assert gap_m(a, b) == pytest.approx(gap)


def test_rectangles_that_touch_by_a_corner_only_after_turning():
    first = Rectangle(0.0, 0.0, 0.0, 0.1, 0.1)
    for yaw, apart in ((0.0, True), (math.pi / 4, False)):
        second = Rectangle(0.22, 0.0, yaw, 0.1, 0.1)  # half its diagonal is 0.141
        assert (gap_m(first, second) > 0) is apart


def test_points_in_and_out_of_the_frame_of_a_rectangle():
    rectangle = Rectangle(0.4, -0.1, 0.6, 0.2, 0.1)
    assert rectangle.frame.to_local(*rectangle.frame.to_world(0.03, -0.07)) == pytest.approx(
        (0.03, -0.07)
    )
    inside = np.array([[*rectangle.frame.to_world(0.19, 0.09), 5.0]])
    outside = np.array([[*rectangle.frame.to_world(0.19, 0.11), 5.0]])
    assert rectangle.contains(inside)
    assert not rectangle.contains(np.concatenate([inside, outside]))
    workspace = Workspace((0.0, 1.0), (-0.5, 0.5), (0.0, 1.0))
    assert rectangle.is_inside(workspace)
    assert not rectangle._replace(x=0.2).is_inside(workspace)  # the centre is, a corner is not


def test_scattered_objects_keep_apart(make):
    env = make(BIN)
    env.reset()
    task = env.scene.task
    fixed = Rectangle(0.45, 0.0, 0.4, 0.08, 0.07)
    footprints = [Footprint(0.02, 0.04, 0.06, 0.016)] * 6
    for seed in range(5):
        places = scatter(task, np.random.default_rng(seed), footprints, [fixed])
        bodies = [Rectangle(*xy, yaw, 0.02, 0.04) for xy, yaw in places]
        for a, b in itertools.combinations([fixed, *bodies], 2):
            assert gap_m(a, b) >= 0.005
        for a, b in itertools.permutations(bodies, 2):  # every one can be grasped
            assert gap_m(a.resized(0.06, 0.016), b) >= 0
    with pytest.raises(PlacementError, match="no room for 60"):
        scatter(task, np.random.default_rng(0), footprints * 10)


# -- shapes ------------------------------------------------------------------------------------


def test_objects_have_the_papers_sizes():
    for shape in pieces(1.0).values():
        size = np.ptp(shape.vertices, axis=0)
        assert (size >= (0.0395, 0.0395, 0.0195)).all()
        assert (size <= (0.0405, 0.0805, 0.0405)).all()
    assert len(pieces(1.0)) == 7
    for profile in BOTTLES_CM.values():
        assert 2 * max(r for r, _ in profile) <= 5.0
        assert 13.0 <= profile[-1][1] <= 14.5
    assert len(BOTTLES_CM) == 8


def test_a_lathe_turns_its_profile():
    lower, upper = lathe_parts([(0.02, 0.0), (0.03, 0.05), (0.01, 0.09)], sides=12)
    for part, ends in ((lower, ((0.02, 0.0), (0.03, 0.05))), (upper, ((0.03, 0.05), (0.01, 0.09)))):
        for radius, z in ends:
            ring = part.vertices[np.isclose(part.vertices[:, 2], z)]
            assert len(ring) == 12
            assert np.hypot(ring[:, 0], ring[:, 1]) == pytest.approx(np.full(12, radius))
        corners = part.vertices[part.faces]
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        (r0, z0), (r1, z1) = ends
        area = 12 / 2 * math.sin(2 * math.pi / 12)  # of the polygon with unit radius
        assert volume == pytest.approx(area * (r0 * r0 + r0 * r1 + r1 * r1) / 3 * (z1 - z0))


def test_an_open_box_is_hollow():
    with World() as world:
        size, wall, floor = (0.2, 0.1, 0.08), 0.004, 0.004
        box = world.add(open_box(size, wall, floor, (1.0, 1.0, 1.0, 1.0)), "box")
        box.place((0.0, 0.0, size[2] / 2))
        ball = world.add(pieces(1.0)["cube"], "cube")
        for x, y, z in ((0.0, 0.0, floor), (0.075, -0.025, floor), (0.2, 0.0, 0.0)):
            ball.place((x, y, 0.15))
            assert world.settle(400)
            assert ball.position == pytest.approx((x, y, z + 0.02), abs=1e-3)
        ball.place((0.098, 0.0, 0.11))  # its middle over a wall: it may not fall through that
        world.step(30)
        assert ball.position[2] > 0.08


@pytest.mark.parametrize(
    ("task", "number"), [(BIN, 11), (BOTTLES, 5), (BOXES, 7), (BOXES, 24), (BOXES, 1)]
)
def test_numbers_that_are_not_offered(task, number):
    with pytest.raises(ConfigError, match="num_objects"):
        ba_torchrl.make(task, num_objects=number)


def test_the_message_lists_the_numbers_of_boxes():
    with pytest.raises(ConfigError, match="6, 12 or 18 objects, not 7"):
        ba_torchrl.make(BOXES, num_objects=7)


# -- bin packing -------------------------------------------------------------------------------


def filled_bin(make, count=4):
    """All objects side by side on the bin's floor."""
    env = make(BIN, num_objects=count)
    env.reset()
    task = env.scene.task
    bin_yaw = task.container.yaw_rad
    inside = Rectangle(*task.container.position[:2], bin_yaw, 0.0, 0.0)
    cells = [(x, y) for x in (-0.06, 0.0, 0.06) for y in (-0.025, 0.025)]
    for body, cell in zip(task.objects, cells, strict=False):
        low = body.shape.bounds_m[0][2]
        body.place((*inside.frame.to_world(*cell), 0.004 - low), bin_yaw)
    for body, cell in zip(task.objects, cells, strict=False):
        if body.shape.bounds_m[1][1] > 0.03:  # long ones would meet: they stand on an end
            turn = yaw_quaternion(bin_yaw)
            x, y, _, w = TURNED
            sz, cz = turn[2], turn[3]
            body.set_pose(
                (*inside.frame.to_world(*cell), 0.044),
                (cz * x - sz * y, cz * y + sz * x, sz * w, cz * w),
            )
    env.scene.world.settle()
    return env, task, inside


def test_objects_in_the_bin_are_packed(make):
    _, task, _ = filled_bin(make)
    assert task.is_success()
    assert task.is_valid()


@pytest.mark.parametrize(
    "along",
    [
        BIN_M[0] / 2 + 0.022,  # beside the bin, against its wall
        BIN_M[0] / 2 - 0.01,  # over the wall
    ],
)
def test_an_object_that_is_not_within_the_walls_is_not_packed(make, along):
    _, task, inside = filled_bin(make)
    body = task.objects[0]
    for z in (-body.shape.bounds_m[0][2], BIN_M[2] - body.shape.bounds_m[0][2]):
        body.place((*inside.frame.to_world(along, 0.0), z), inside.yaw_rad)
        assert not task.is_packed(body)
        assert not task.is_success()


def test_an_object_on_the_rim_is_not_packed(make):
    _, task, inside = filled_bin(make, count=1)
    (body,) = task.objects
    assert task.is_success()
    low = body.shape.bounds_m[0][2]
    # its middle is inside the bin, its end rests on the rim
    body.place((*inside.frame.to_world(BIN_M[0] / 2 - 0.015, 0.0), BIN_M[2] - low), inside.yaw_rad)
    assert not task.is_packed(body)
    # above the rim altogether
    body.place((*inside.frame.to_world(0.0, 0.0), BIN_M[2] - low + 0.001), inside.yaw_rad)
    assert not task.is_packed(body)


def test_what_is_held_is_not_packed(make):
    env = make(BIN, num_objects=1)
    state = env.reset()
    (picked,) = follow(env, state, 1)
    assert picked["holding"]
    assert not env.scene.task.is_success()


def test_objects_are_let_go_over_the_rim_or_gently_on_the_ground(make):
    env = make(BIN, num_objects=2)
    follow(env, env.reset(), 1)
    task = env.scene.task
    depth = task.depth_m(env.scene.controller.held)
    assert task.place_height_m(0.0, (0.4, 0.0)) == pytest.approx(depth, abs=2e-3)
    assert task.place_height_m(0.004, (0.4, 0.0)) > BIN_M[2] + 0.009  # the fingertips
    assert task.place_height_m(0.12, (0.4, 0.0)) == pytest.approx(0.12 + depth, abs=2e-3)


def test_kinds_are_drawn_with_replacement(make):
    env = make(BIN)
    seen = []
    for _ in range(12):
        env.reset()
        seen.append([body.name.split()[0] for body in env.scene.task.objects])
    assert all(len(kinds) == 8 for kinds in seen)
    assert {kind for kinds in seen for kind in kinds} == set(pieces(1.0))
    assert any(kinds.count(kind) >= 3 for kinds in seen for kind in kinds)


# -- bottles -----------------------------------------------------------------------------------


def stand_bottles(make):
    """All bottles in their slots."""
    env = make(BOTTLES)
    env.reset()
    task = env.scene.task
    tray = Rectangle(*task.container.position[:2], task.container.yaw_rad, 0.0, 0.0)
    for body, slot in zip(task.objects, bottle_slots(), strict=True):
        body.place((*tray.frame.to_world(*slot), 0.005), 0.3)
    env.scene.world.settle()
    return env, task, tray


def test_bottles_that_stand_in_the_tray_are_arranged(make):
    _, task, _ = stand_bottles(make)
    assert task.is_success()
    assert task.is_valid()


def test_a_bottle_lying_in_the_tray_ends_the_episode(make):
    _, task, tray = stand_bottles(make)
    body = task.objects[1]
    lying = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    body.set_pose((*tray.frame.to_world(0.0, 0.0), 0.2), lying)
    assert not task.is_success()
    assert not task.is_valid()


@pytest.mark.parametrize(
    ("place", "z"),
    [
        ((0.147, 0.0), 0.0),  # outside, against the wall
        ((0.0, 0.106), 0.0),
        ((0.115, 0.0), 0.05),  # upright on the wall
        ((0.0, 0.0), 0.02),  # above the floor
    ],
)
def test_a_bottle_that_does_not_stand_on_the_trays_floor(make, place, z):
    _, task, tray = stand_bottles(make)
    task.objects[1].place((*tray.frame.to_world(*place), z), 0.0)
    assert not task.stands_in_tray(task.objects[1])
    assert not task.is_success()


def test_bottles_may_stand_off_their_slots(make):
    _, task, tray = stand_bottles(make)
    task.objects[0].place((*tray.frame.to_world(-0.083, -0.041), 0.005), 0.0)
    assert task.is_success()


def test_bottles_right_themselves(make):
    env = make(BOTTLES)
    env.reset()
    task = env.scene.task
    for body in task.objects:
        x, y, _ = body.position
        lean = math.radians(15)
        base = 0.026 * math.sin(lean)  # the lower edge stays above ground
        body.set_pose((x, y, base), (math.sin(lean / 2), 0.0, 0.0, math.cos(lean / 2)))
    env.scene.world.settle(600)
    assert all(body.tilt_rad < 0.02 for body in task.objects)


# -- boxes -------------------------------------------------------------------------------------


class Pallet:
    """Boxes put into slots by hand."""

    def __init__(self, env, count):
        env.reset()
        self.env, self.task = env, env.scene.task
        pallet = self.task.container
        self.frame = Rectangle(*pallet.position[:2], pallet.yaw_rad, 0.0, 0.0)
        while len(self.task.objects) < count:
            self.task._bring()
        for number in range(count):
            self.put(number)
        env.scene.world.settle()

    def put(self, number, box=None, dx=0.0, dy=0.0, level=0, turn=0.0):
        """Put a box into a slot, or off it."""
        layer, place = divmod(number, 6)
        x, y, yaw = slots(layer)[place]
        z = PALLET_M[2] + (layer + level + 0.5) * BOX_M[2]
        body = self.task.objects[number if box is None else box]
        body.place((*self.frame.frame.to_world(x + dx, y + dy), z), self.frame.yaw_rad + yaw + turn)
        return body


def test_layers_fit_the_pallet_and_cross_each_other():
    for layer in range(3):
        rectangles = [
            Rectangle(x, y, yaw, BOX_M[0] / 2, BOX_M[1] / 2) for x, y, yaw in slots(layer)
        ]
        for a, b in itertools.combinations(rectangles, 2):
            assert gap_m(a, b) >= 0.015 - 1e-9
        for rectangle in rectangles:
            for sx, sy in itertools.product((-1, 1), repeat=2):
                x, y = rectangle.frame.to_world(sx * rectangle.half_x, sy * rectangle.half_y)
                assert abs(x) <= PALLET_M[0] / 2
                assert abs(y) <= PALLET_M[1] / 2
    assert sorted(slots(0)) == sorted(slots(2))
    assert math.cos(slots(0)[0][2] - slots(1)[0][2]) == pytest.approx(0.0)
    for upper in slots(1):  # each lies over the gap between two
        below = [
            lower
            for lower in slots(0)
            if gap_m(
                Rectangle(*upper, BOX_M[0] / 2, BOX_M[1] / 2),
                Rectangle(*lower, BOX_M[0] / 2, BOX_M[1] / 2),
            )
            < 0
        ]
        assert len(below) >= 2


def test_full_layers_are_the_goal_and_stand(make):
    for count in (6, 12, 18):
        env = make(BOXES, num_objects=count)
        pallet = Pallet(env, count)
        assert pallet.task.is_success()
        assert pallet.task.is_valid()
        before = [body.position for body in pallet.task.objects]
        env.scene.world.step(240)
        for body, position in zip(pallet.task.objects, before, strict=True):
            assert math.dist(body.position, position) < 1e-3


@pytest.mark.parametrize(
    ("off", "counts"),
    [
        ({}, True),
        ({"dx": 0.9 * SLOT_M, "dy": -0.9 * SLOT_M}, True),
        ({"turn": math.pi}, True),
        ({"turn": 0.35}, True),
        ({"turn": 0.45}, False),
        ({"turn": math.pi / 2}, False),
        ({"dx": 1.2 * SLOT_M}, False),
        ({"dy": -0.067}, False),  # a slot off, beyond the last
        ({"dy": 0.067}, False),  # where another box is
        ({"level": 1}, False),
        ({"level": -1}, False),
    ],
)
def test_a_box_counts_in_its_slot_only(make, off, counts):
    pallet = Pallet(make(BOXES, num_objects=6), 6)
    pallet.put(0, **off)
    assert pallet.task.is_success() is counts


def test_boxes_count_on_full_layers_only(make):
    pallet = Pallet(make(BOXES, num_objects=12), 7)
    assert len(pallet.task.filled()) == 7
    pallet.task.objects[2].place((0.3, 0.15, BOX_M[2] / 2), 0.0)
    assert len(pallet.task.filled()) == 5


def test_a_box_may_lie_on_any_long_side_but_not_stand(make):
    pallet = Pallet(make(BOXES, num_objects=6), 6)
    body = pallet.task.objects[0]
    position, (_, _, z, w) = body.pose
    half = math.sqrt(0.5)
    rolled = [(0.0, half), (half, 0.0)]  # about its length (y), about its width (x)
    for (x, y), counts in zip(rolled, (True, False), strict=True):
        # the yaw after the quarter turn
        body.set_pose(position, (w * x - z * y, w * y + z * x, z * half, w * half))
        assert (body in pallet.task.filled().values()) is counts


def test_a_new_box_comes_after_a_correct_place_only(make):
    env = make(BOXES, num_objects=6)
    state = env.reset()
    task, world = env.scene.task, env.scene.world
    arrivals = list(task._arrivals)
    assert [not body.is_hidden for body in task.pool.bodies] == [True] + [False] * 5
    (state,) = follow(env, state, 1)
    assert state["holding"]
    assert len(task.objects) == 1
    # a place one slot too far: it stays on the pallet, and no box comes
    wrong = state["expert_action"].clone()
    yaw = task.container.yaw_rad
    for sign in (-1, 1):  # where there is no slot: outwards along the row
        off = (sign * 0.067 * -math.sin(yaw), sign * 0.067 * math.cos(yaw))
        if math.dist((wrong[1] + off[0], wrong[2] + off[1]), task.container.position[:2]) > 0.1:
            break
    wrong[1:3] += torch.tensor(off)
    state = env.step(state.clone().set("action", wrong))["next"]
    assert not state["holding"]
    assert not state["done"]
    assert len(task.objects) == 1
    # the expert repairs it, and then one comes
    state = follow(env, state, 2)[-1]
    assert not state["holding"]
    assert len(task.objects) == 2
    assert len(task.filled()) == 1
    (x, y), _ = arrivals[1]
    assert task.objects[1].position[:2] == pytest.approx((x, y), abs=1e-3)
    assert world.is_still()
    assert follow(env, state)[-1]["success"]


def test_boxes_to_come_are_out_of_sight_and_cost_nothing_to_settle(make):
    env = make(BOXES, obs_size=128)
    state = env.reset()
    task = env.scene.task
    present = task.objects[0]
    pixels = state["pixels"][0].numpy()
    assert 0.04 < pixels.max() < 0.05
    area = (pixels > 0.04).sum() * (0.4 / 128) ** 2
    assert area == pytest.approx(BOX_M[0] * BOX_M[1], rel=0.15)
    assert env.scene.world.settle(10)
    assert all(body.is_hidden for body in task.pool.bodies if body is not present)


def test_a_state_brings_back_which_boxes_are_there(make):
    env = make(BOXES, num_objects=6)
    state = env.reset()
    state = follow(env, state, 3)[-1]  # the second box is in the gripper
    kept = env.get_state()
    first = follow(env, state)
    assert len(env.scene.task.objects) == 6
    assert first[-1]["success"]
    returned = env.set_state(kept)
    task = env.scene.task
    assert len(task.objects) == 2
    assert [body.is_hidden for body in task.pool.bodies] == [False] + [True] * 5  # one is held
    second = follow(env, returned)
    assert len(first) == len(second)
    assert all((a == b).all() for a, b in zip(first, second, strict=True))
    env.reset()
    returned = env.set_state(kept)
    assert (follow(env, returned)[-1] == first[-1]).all()


def test_the_expert_tips_over_a_box_that_stands_on_its_end(make):
    env = make(BOXES, num_objects=6, max_steps=40)
    nothing = torch.tensor([float(PLACE), 0.3, 0.0, 0.0])
    state = env.step(env.reset().set("action", nothing))["next"]
    body = env.scene.task.objects[0]
    x, y, _ = body.position
    body.set_pose((x, y, BOX_M[1] / 2), TURNED)
    state = env.step(state.set("action", nothing))["next"]
    assert body.tilt_rad > 1.5
    seen = follow(env, state)
    assert seen[-1]["success"]
    assert len(seen) <= 12 + 4


# -- experts -----------------------------------------------------------------------------------

VARIANTS = {
    "3D": {},
    "6D": {"action_sequence": "pxyzrrr"},
    "2D": {"random_orientation": False, "action_sequence": "pxy"},
}
TASKS = [
    (BIN, {}, 16, "3D"),
    (BIN, {"num_objects": 4}, 8, "6D"),
    (BIN, {}, 16, "2D"),
    (BOTTLES, {}, 12, "3D"),
    (BOTTLES, {}, 12, "6D"),
    (BOTTLES, {}, 12, "2D"),
    (BOXES, {}, 36, "3D"),
    (BOXES, {"num_objects": 6}, 12, "6D"),
    (BOXES, {"num_objects": 6}, 12, "2D"),  # every other layer needs the yaw
]


def check_expert(make, task, config, optimum, variant, episodes, least):
    env = make(task, **{"obs_size": 128, **config, **VARIANTS[variant]})
    lengths = []
    for _ in range(episodes):
        seen = follow(env, env.reset())
        if seen[-1]["success"]:
            lengths.append(len(seen))
    assert len(lengths) >= least * episodes
    assert np.median(lengths) == optimum
    assert env.faults == 0


@pytest.mark.parametrize(("task", "config", "optimum", "variant"), TASKS)
def test_the_expert_takes_the_fewest_steps(make, task, config, optimum, variant):
    check_expert(make, task, config, optimum, variant, episodes=4, least=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "config", "optimum", "variant"), TASKS)
def test_the_expert_over_200_episodes(make, task, config, optimum, variant):
    check_expert(make, task, config, optimum, variant, episodes=200, least=0.99)


@pytest.mark.parametrize("robot", ["panda", "ur5", "ur5_robotiq"])
@pytest.mark.parametrize(
    ("task", "config"), [(BIN, {"num_objects": 3}), (BOTTLES, {}), (BOXES, {})]
)
def test_other_robots_do_it_too(make, task, config, robot):
    env = make(task, obs_size=128, robot=robot, **config)
    assert follow(env, env.reset())[-1]["success"]


@pytest.mark.parametrize(("task", "least"), [(BIN, 0.7), (BOXES, 0.9)])
def test_the_expert_recovers_from_careless_actions(make, task, least):
    env = make(task, obs_size=128, num_objects=6, max_steps=60)
    space = env.action_spec.space
    outcomes = []
    for episode in range(14):
        state = env.reset(seed=episode)
        rng = np.random.default_rng(episode)
        for _ in range(6):
            action = state["expert_action"].clone()
            action[1:3] += torch.from_numpy(rng.uniform(-0.03, 0.03, 2).astype(np.float32))
            action[3] += rng.uniform(-0.4, 0.4)
            action = torch.maximum(torch.minimum(action, space.high), space.low)
            state = env.step(state.clone().set("action", action))["next"]
            if state["done"]:
                break
        else:
            outcomes.append(bool(follow(env, state)[-1]["success"]))
    # what was dropped flat against the outside of the bin has no room for a finger
    assert len(outcomes) >= 9
    assert np.mean(outcomes) >= least, outcomes


def test_what_is_narrow_is_found_in_any_pose(make):
    env = make(BIN)
    env.reset()
    body = next(b for b in env.scene.task.pool.bodies if b.name.startswith("plank"))
    for yaw in (0.0, 0.9, 2.5):
        body.place((0.4, 0.0, 0.01), yaw)
        (found,) = narrowest(body)
        assert found.half_x == pytest.approx(0.02)
        assert found.half_y == pytest.approx(0.04)
        assert math.cos(2 * (found.yaw_rad - yaw)) == pytest.approx(1.0)
    cube = next(b for b in env.scene.task.pool.bodies if b.name.startswith("cube"))
    cube.place((0.4, 0.0, 0.02), 0.3)
    assert len(narrowest(cube)) == 2
