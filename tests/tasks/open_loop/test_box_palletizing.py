"""Box palletizing: slots and layers, boxes that appear one by one, the expert."""

import itertools
import math

import pytest
import torch

from ba_torchrl.core.actions import PLACE
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, outline
from ba_torchrl.tasks.open_loop.box_palletizing import BOX_M, PALLET_M, SLOT_M, slots
from tests.tasks.episodes import follow
from tests.tasks.packing.scenes import BOXES, QUARTER_TURN


class Pallet:
    """A pallet with boxes in given slots."""

    def __init__(self, env, count):
        env.reset()
        self.env, self.task = env, env.scene.task
        pallet = self.task.container
        self.frame = Rectangle(*pallet.position[:2], pallet.yaw_rad, 0.0, 0.0)
        while len(self.task.objects) < count:
            self.task._activate_next_box()
        for number in range(count):
            self.put(number)
        env.scene.world.settle()

    def put(self, number, box=None, dx=0.0, dy=0.0, level=0, turn=0.0):
        """Place a box in a slot, or at an offset from it."""
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
    halves = BOX_M[0] / 2, BOX_M[1] / 2
    for upper in slots(1):  # each lies across at least two of the layer below
        gaps = [gap_m(Rectangle(*upper, *halves), Rectangle(*lower, *halves)) for lower in slots(0)]
        assert sum(gap < 0 for gap in gaps) >= 2


def test_full_layers_are_the_goal_and_stable(make_env):
    for count in (6, 18):
        env = make_env(BOXES, num_objects=count)
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
        ({"dy": -0.067}, False),  # one slot too far, beyond the last
        ({"dy": 0.067}, False),  # at another box
        ({"level": 1}, False),
        ({"level": -1}, False),
    ],
)
def test_a_box_counts_in_its_slot_only(make_env, off, counts):
    pallet = Pallet(make_env(BOXES, num_objects=6), 6)
    pallet.put(0, **off)
    assert pallet.task.is_success() is counts


def test_boxes_count_on_full_layers_only(make_env):
    pallet = Pallet(make_env(BOXES, num_objects=12), 7)
    assert len(pallet.task.stacked()) == 7
    pallet.task.objects[2].place((0.3, 0.15, BOX_M[2] / 2), 0.0)
    assert len(pallet.task.stacked()) == 5


def test_a_box_may_lie_on_any_long_side_but_not_on_its_end(make_env):
    pallet = Pallet(make_env(BOXES, num_objects=6), 6)
    body = pallet.task.objects[0]
    position, (_, _, z, w) = body.pose
    half = math.sqrt(0.5)
    rolled = [(0.0, half), (half, 0.0)]  # about its length (y), about its width (x)
    for (x, y), counts in zip(rolled, (True, False), strict=True):
        # the yaw after the quarter turn
        body.set_pose(position, (w * x - z * y, w * y + z * x, z * half, w * half))
        assert (body in pallet.task.stacked().values()) is counts


def test_a_new_box_appears_after_a_correct_place_only(make_env):
    env = make_env(BOXES, num_objects=6)
    state = env.reset()
    task, world = env.scene.task, env.scene.world
    arrivals = list(task._arrivals)
    assert [not body.is_hidden for body in task.pool.bodies] == [True] + [False] * 5
    (state,) = follow(env, state, 1)
    assert state["holding"]
    assert len(task.objects) == 1
    # a place one slot too far: the box stays on the pallet, and no new box appears
    wrong = state["expert_action"].clone()
    yaw = task.container.yaw_rad
    for sign in (-1, 1):  # the direction without a slot: outwards along the row
        off = (sign * 0.067 * -math.sin(yaw), sign * 0.067 * math.cos(yaw))
        if math.dist((wrong[1] + off[0], wrong[2] + off[1]), task.container.position[:2]) > 0.1:
            break
    wrong[1:3] += torch.tensor(off)
    state = env.step(state.clone().set("action", wrong))["next"]
    assert not state["holding"]
    assert not state["done"]
    assert len(task.objects) == 1
    # the expert corrects it, also if a pick on the edge fails, and then a new box appears
    for _ in range(8):
        if len(task.objects) == 2:
            break
        assert not task.stacked()
        state = follow(env, state, 1)[-1]
    assert not state["holding"]
    assert len(task.objects) == 2
    assert len(task.stacked()) == 1
    (x, y), _ = arrivals[1]
    assert task.objects[1].position[:2] == pytest.approx((x, y), abs=1e-3)
    assert world.is_still()
    assert follow(env, state)[-1]["success"]


def test_inactive_boxes_are_hidden_and_do_not_delay_settling(make_env):
    env = make_env(BOXES, obs_size=128)
    state = env.reset()
    task = env.scene.task
    present = task.objects[0]
    heightmap = state["heightmap"][0].numpy()
    assert 0.04 < heightmap.max() < 0.05
    area = (heightmap > 0.04).sum() * (0.4 / 128) ** 2
    assert area == pytest.approx(BOX_M[0] * BOX_M[1], rel=0.15)
    assert env.scene.world.settle(10)
    assert all(body.is_hidden for body in task.pool.bodies if body is not present)


def test_a_state_restores_which_boxes_are_active(make_env):
    env = make_env(BOXES, num_objects=6)
    follow(env, env.reset(), 3)  # the second box is in the gripper
    kept, task = env.get_state(), env.scene.task
    for _ in range(2):
        env.reset()
        assert len(task.objects) == 1
        returned = env.reset(kept, set_state=True)
        assert len(task.objects) == 2
        assert [body.is_hidden for body in task.pool.bodies] == [False] + [True] * 5  # one is held
    assert follow(env, returned)[-1]["success"]


def test_the_expert_tips_over_a_box_that_stands_on_its_end(make_env):
    env = make_env(BOXES, num_objects=6, max_steps=40)
    nothing = torch.tensor([float(PLACE), 0.3, 0.0, 0.0])
    state = env.step(env.reset().set("action", nothing))["next"]
    body = env.scene.task.objects[0]
    x, y, _ = body.position
    body.set_pose((x, y, BOX_M[1] / 2), QUARTER_TURN)
    state = env.step(state.set("action", nothing))["next"]
    assert body.tilt_rad > 1.5
    seen = follow(env, state)
    assert seen[-1]["success"]
    assert len(seen) <= 12 + 4


def test_a_box_is_placed_as_little_off_the_centre_of_its_slot_as_the_fingers_need(make_env):
    pallet = Pallet(make_env(BOXES, num_objects=6), 4)  # a column, and the first of the other one
    task, inside = pallet.task, pallet.task.container_outline()
    x, y, yaw = slots(0)[4]
    at = pallet.frame.frame.to_world(x, y)
    slot = Rectangle(*at, inside.yaw_rad + yaw, BOX_M[0] / 2, BOX_M[1] / 2)

    def shift_m():
        neighbors = [outline(body) for body in task.stacked().values()]
        site = task._site(slot, 0, neighbors)
        return math.dist(site[:2], slot[:2])

    for off_m, turn in ((0.0, 0.0), (0.004, 0.0), (0.0, 0.08), (-0.009, 0.3)):
        pallet.put(3, dy=off_m, turn=turn)
        pallet.put(1, dx=-0.004, turn=0.05)  # end to end with the slot, where no finger is
        assert shift_m() == 0.0
    pallet.put(3, dy=0.009)
    assert shift_m() == pytest.approx(0.003, abs=6e-4)
