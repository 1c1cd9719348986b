"""The covid test: scenes, what counts as a test, failures and success, expert, states."""

import itertools
import math
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from ba_torchrl.core.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, downward
from ba_torchrl.tasks.open_loop.covid import NEW_BOX, SHEET_M, TEST_AREA, USED_BOX, WALL_M

TASK = "open_loop/covid_test"
FIXED = {"random_orientation": False, "action_sequence": "pxy"}
UP, DOWN = (0.0, 0.06), (0.0, -0.06)
"""Spots in the test area."""
ROWS = [(0.0, y) for y in (-0.024, 0.0, 0.024)]
"""Spots in the box of used tubes."""
ELSEWHERE = ["new_box", "across the rim", "beside"]


@pytest.fixture
def make(make_env):
    def build(**config):
        env = make_env(TASK, **config)
        env.reset()
        return env

    return build


def step(env, action):
    """Take a step with an action vector or a command."""
    if isinstance(action, PickPlaceCommand):
        action = env.actions.encode(action)
    return env.step(env.full_action_spec.zero().set("action", torch.as_tensor(action)))["next"]


def wait(env):
    """Take a step that moves no object: a place with an empty gripper."""
    assert env.scene.task.robot.held_body() is None
    return step(env, PickPlaceCommand(PLACE, 0.3, 0.0, 0.1))


def follow(env, count):
    """Take expert actions, at most to the end of the episode; return the last state."""
    for _ in range(count):
        state = step(env, env._expert_action(env.scene))
        if state["done"]:
            break
    return state


def lay(task, body, area, spot, along=math.pi / 2):
    """Place a tube or swab on the floor of an area, with position and yaw in the area's frame."""
    task.layout.lay(body, task.layout.to_world(area, spot), area.yaw_rad + along)


def lay_pair(task, tube=0, swab=0):
    """Lay a tube and a swab into the test area."""
    lay(task, task.tubes[tube], task.layout.test_area, UP)
    lay(task, task.swabs[swab], task.layout.test_area, DOWN)


def collect(task, tube, spot=ROWS[1]):
    """Lay a tube into the box of used tubes."""
    lay(task, task.tubes[tube], task.layout.used_box, spot, along=0.0)


def misplace(task, tube, where):
    """Place a used tube outside its box."""
    if where == "new_box":
        lay(task, tube, task.layout.new_box, (0.0, 0.04))
    elif where == "across the rim":  # across the corner, its centre above the inside
        rim = USED_BOX.size[2] + tube.shape.size_m[2] / 2
        x, y = task.layout.to_world(task.layout.used_box, (0.037, 0.027))
        tube.place((x, y, rim), task.layout.used_box.yaw_rad - math.atan2(0.046, 0.056))
    elif where == "beside":
        lay(task, tube, task.layout.used_box, (0.0, 0.064), along=0.0)


def carry_out_tests(env):
    """Carry out all tests, with the first two used tubes side by side in their box."""
    task = env.scene.task
    for i in range(3):
        lay_pair(task, i, i)
        assert not wait(env)["done"]
        assert len(task.get_state().used_tubes) == i + 1
        if i < 2:
            collect(task, i, ROWS[i])
    return task


def local(area, point):
    """Return x and y of a point in an area's frame."""
    return PlanarFrame(*area.position[:2], area.yaw_rad).to_local(*point[:2])


def is_within(area, spec, point, margin_m=0.0):
    """Return whether a point is inside the outline of an area."""
    x, y = local(area, point)
    return abs(x) < spec.size[0] / 2 - margin_m and abs(y) < spec.size[1] / 2 - margin_m


# -- scenes ------------------------------------------------------------------------------------


def test_layouts_are_random_adjacent_and_inside_the_workspace(make):
    env = make()
    yaws, sides, centers = [], [], []
    signs = list(itertools.product((-0.5, 0.5), repeat=2))
    for _ in range(60):
        env.reset()
        layout = env.scene.task.layout
        areas = {layout.new_box: NEW_BOX, layout.used_box: USED_BOX, layout.test_area: TEST_AREA}
        corners = {}
        for area, spec in areas.items():
            points = [layout.to_world(area, np.multiply(spec.size[:2], sign)) for sign in signs]
            corners[area] = points = np.array(points)
            assert (points >= (0.25 - 1e-9, -0.2 - 1e-9)).all()
            assert (points <= (0.65 + 1e-9, 0.2 + 1e-9)).all()
        for other in (layout.used_box, layout.test_area):
            apart = corners[layout.new_box][:, None] - corners[other][None]
            assert np.linalg.norm(apart, axis=-1).min() < 0.06
        assert len({area.yaw_rad for area in areas}) == 1
        yaws.append(layout.new_box.yaw_rad)
        centers.append(layout.test_area.position[:2])
        x, _ = local(layout.new_box, layout.test_area.position)
        assert abs(x) == pytest.approx(0.1525, abs=1e-6)
        sides.append(x > 0)
    quarters = np.round(np.array(yaws) / (math.pi / 2)).astype(int) % 4
    assert set(quarters) == {0, 1, 2, 3}
    off = np.degrees((np.array(yaws) + math.pi / 4) % (math.pi / 2) - math.pi / 4)
    assert 15 < np.abs(off).max() <= 18.5
    assert {True, False} == set(sides)  # mirrored or not
    assert np.ptp(centers, axis=0).min() > 0.15


def test_tubes_and_swabs_start_apart_on_the_floor_of_their_box(make):
    env = make()
    for _ in range(20):
        env.reset()
        task = env.scene.task
        assert task.objects == [*task.tubes, *task.swabs]
        for body in task.objects:
            size = (0.08, 0.017, 0.017) if body in task.tubes else (0.07, 0.01, 0.01)
            assert body.shape.size_m == pytest.approx(size)
            assert is_within(task.layout.new_box, NEW_BOX, body.position, WALL_M)
            assert vertical_extent(body)[0] == pytest.approx(SHEET_M, abs=3e-4)
            assert body.tilt_rad < 0.01
            others = [other for other in task.objects if other is not body]
            assert min(math.dist(body.position, other.position) for other in others) > 0.045


def test_fixed_orientations_lie_along_y(make):
    env = make(**FIXED)
    yaws = set()
    for _ in range(12):
        env.reset()
        task = env.scene.task
        yaws.add(round(abs(task.layout.new_box.yaw_rad), 6))
        for body in task.objects:
            assert body.yaw_rad == pytest.approx(math.pi / 2, abs=1e-2)
    assert yaws == {0.0, round(math.pi, 6)}


# -- tests -------------------------------------------------------------------------------------


def test_a_pair_in_the_test_area_becomes_a_test(make):
    env = make()
    task = env.scene.task
    lay_pair(task, tube=1, swab=2)
    before = env._heightmap(env.scene)
    assert not wait(env)["done"]
    assert task.get_state()[1:] == ((1,), (2,), False)
    assert task.swabs[2].is_hidden
    assert task.swabs[2] not in task.objects
    assert len(task.objects) == 5
    x, y = local(task.layout.test_area, task.tubes[1].position)
    assert abs(x) < 0.0126
    assert abs(y) < 0.1001
    assert (x, y) != pytest.approx(UP, abs=1e-3)  # it has a new pose
    assert env.scene.world.is_still()
    lost = (before > 0.006).sum() - (env._heightmap(env.scene) > 0.006).sum()
    assert lost == pytest.approx(0.07 * 0.01 / env.pixel_m**2, rel=0.35)  # the pixels of the swab
    task.swabs[0].place((0.7, 0.0, 0.005), 0.0)  # outside the workspace
    assert not task.is_valid()
    assert not task.has_failed


@pytest.mark.parametrize("first", [0, 1])
def test_swab_and_tube_come_in_any_order_and_one_alone_is_not_a_test(make, first):
    env = make()
    task = env.scene.task
    lay(task, task.swabs[1], task.layout.used_box, (0.0, 0.0), along=0.0)  # without a meaning
    pair = [(task.tubes[0], UP), (task.swabs[0], DOWN)]
    for number, used in ((first, ()), (1 - first, (0,))):
        lay(task, pair[number][0], task.layout.test_area, pair[number][1])
        assert not wait(env)["done"]
        assert task.get_state()[1:] == (used, used, False)


def test_poses_of_used_tubes_are_random_and_depend_on_the_seed(make):
    spots = []
    for seed in (0, 1, 2, 0):
        env = make(seed=seed)
        task = env.scene.task
        lay_pair(task)
        wait(env)
        spots.append((*local(task.layout.test_area, task.tubes[0].position), task.tubes[0].yaw_rad))
    assert spots[0] == spots[3]
    assert len(set(spots)) == 3


def test_a_used_tube_is_placed_clear_of_other_objects(make):
    env = make()
    task = env.scene.task
    for attempt in range(6):
        env.reset()
        lay_pair(task)
        # their centres are outside the test area, but they extend far into it
        side = math.copysign(0.0585, local(task.layout.new_box, task.layout.test_area.position)[0])
        for tube, y in ((1, 0.03), (2, -0.03)):
            lay(task, task.tubes[tube], task.layout.test_area, (side, y), along=0.0)
        where = [tube.position for tube in task.tubes[1:]]
        assert not wait(env)["done"], attempt
        assert task.get_state().used_tubes == (0,)
        for tube, position in zip(task.tubes[1:], where, strict=True):
            assert math.dist(tube.position, position) < 2e-3
        assert vertical_extent(task.tubes[0])[0] == pytest.approx(SHEET_M, abs=5e-4)


def test_a_held_object_above_the_test_area_is_not_presented(make):
    env = make()
    task = env.scene.task
    follow(env, 1)
    held = task.robot.held_body()
    assert held in task.tubes
    x, y = task.layout.to_world(task.layout.test_area, (0.0, 0.0))
    joints = task.robot.inverse_kinematics((x, y, 0.1), downward(0.0))
    env.scene.controller._teleport(joints)
    env.scene.world.step(2)
    assert math.dist(held.position[:2], (x, y)) < 0.02
    assert task.robot.held_body() is held
    assert not task._is_presented(held)


TUBE, SWAB = ("tubes", 0), ("swabs", 0)
TUBE_2, SWAB_2 = ("tubes", 1), ("swabs", 1)
PAIR = {TUBE: UP, SWAB: DOWN}
SECOND_PAIR = {TUBE_2: UP, SWAB_2: DOWN}


@pytest.mark.parametrize(
    "stages",
    [
        [{TUBE: UP, TUBE_2: DOWN}],
        [{SWAB: UP, SWAB_2: DOWN}],
        [{TUBE: UP, SWAB: DOWN, SWAB_2: (0.03, -0.06)}],
        [PAIR, {TUBE: UP, SWAB_2: DOWN}],  # beside an uncollected used tube
        [PAIR, {TUBE: UP, TUBE_2: DOWN}],
        [PAIR, {TUBE: "used_box"}, {TUBE: UP, SWAB_2: DOWN}],  # a collected tube again
        # a used tube may be anywhere outside the test area, but not during the next test
        *([PAIR, {TUBE: where}, SECOND_PAIR] for where in ELSEWHERE),
    ],
)
def test_a_pair_against_the_rules_ends_the_episode(make, stages):
    env = make()
    task = env.scene.task
    for stage in stages:
        for (kind, number), where in stage.items():
            body = getattr(task, kind)[number]
            if where == "used_box":
                collect(task, number)
            elif isinstance(where, str):
                misplace(task, body, where)
            else:
                lay(task, body, task.layout.test_area, where)
        if stage is not stages[-1]:
            assert not wait(env)["done"]
    state = wait(env)
    assert task.has_failed
    assert state["terminated"]
    assert not state["success"]
    assert state["reward"] == 0.0


# -- success -----------------------------------------------------------------------------------


def test_three_used_tubes_in_their_box_are_a_success(make):
    env = make()
    for tube, spot in enumerate(ROWS):
        collect(env.scene.task, tube, spot)
    assert not wait(env)["done"]  # no test was made
    task = carry_out_tests(env)
    assert not task.is_success()
    collect(task, 2, ROWS[2])
    state = wait(env)
    assert state["success"]
    assert state["terminated"]
    assert state["reward"] == 1.0
    step(env, task.expert_command())  # it changes nothing
    assert task.is_success()


@pytest.mark.parametrize("where", [*ELSEWHERE, "test area"])
def test_the_last_tube_elsewhere_is_not_a_success(make, where):
    env = make()
    task = carry_out_tests(env)
    tube = task.tubes[2]
    misplace(task, tube, where)
    state = wait(env)
    assert not state["success"]
    assert not state["done"]
    assert not task.is_collected(tube)
    if where == "across the rim":  # where its centre is inside
        assert is_within(task.layout.used_box, USED_BOX, tube.position, WALL_M)
        assert vertical_extent(tube)[0] > USED_BOX.size[2] - 2e-3


def test_a_tube_in_the_gripper_is_not_collected(make):
    env = make()
    task = carry_out_tests(env)
    follow(env, 1)
    assert task.robot.held_body() is task.tubes[2]
    assert not task.is_success()
    assert follow(env, 1)["success"]


# -- expert ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [307, 312])
def test_the_expert_picks_objects_at_a_wall_last(make, seed):
    env = make(max_steps=60)
    state, rng = env.reset(seed=seed), np.random.default_rng(seed - 300)
    for _ in range(6):
        action = state["expert_action"].clone()
        action[1:3] += torch.tensor(rng.normal(0, 0.015, 2), dtype=torch.float32)
        state = env.step(state.set("action", action))["next"]
        assert not state["done"]
    assert not follow(env, 54)["truncated"]


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5"])
def test_fingers_reach_all_new_objects_and_leave_neighbours_where_they_are(make, robot):
    env = make(robot=robot, obs_size=128)  # some are wide above the walls
    for seed in range(5):
        env.reset(seed=seed)
        task = env.scene.task
        assert all(map(task._can_grasp, task.objects))
        where = {body: body.position for body in task.objects}
        follow(env, 1)
        held = task.robot.held_body()
        assert held in task.tubes
        moved = [math.dist(body.position, xyz) for body, xyz in where.items() if body is not held]
        assert max(moved) < 1e-3


@pytest.mark.parametrize("case", ["a misplaced used tube", "a fresh tube in the wrong box"])
def test_the_expert_continues_after(make, case):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    if case == "a misplaced used tube":
        lay_pair(task)
        wait(env)
        lay(task, task.tubes[0], task.layout.new_box, (0.0, -0.01), along=0.2)
    else:
        collect(task, 1)
    assert follow(env, 40)["success"]


def test_the_expert_puts_back_objects_that_it_must_not_present(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    lay_pair(task)
    wait(env)
    for body in (task.tubes[1], task.swabs[1]):
        x, y, z = body.position
        step(env, PickPlaceCommand(PICK, x, y, z + 0.003, body.yaw_rad + math.pi / 2))
        assert task.robot.held_body() is body
        follow(env, 1)
        assert task.robot.held_body() is None
        assert is_within(task.layout.new_box, NEW_BOX, body.position)
    assert not task.has_failed
    assert follow(env, 40)["success"]


@pytest.mark.parametrize("kind", ["tubes", "swabs"])
def test_heights_from_the_image_fit_thin_objects(make, monkeypatch, kind):
    env = make(obs_size=128)
    task = env.scene.task
    body = getattr(task, kind)[1]
    x, y, _ = body.position
    step(env, PickPlaceCommand(PICK, x, y, None, body.yaw_rad + math.pi / 2))
    assert task.robot.held_body() is body
    x, y = task.layout.to_world(task.layout.test_area, (0.0, 0.03))
    place = Mock(wraps=env.scene.controller.place)
    monkeypatch.setattr(env.scene.controller, "place", place)
    below = task.robot.tool_pose()[0][2] - vertical_extent(body)[0]
    step(env, PickPlaceCommand(PLACE, x, y, None, 0.0))
    gap = place.call_args.args[0][2] - below - SHEET_M
    assert 0 < gap < 0.011  # at most the height of the low rim next to the test area
    assert math.dist(body.position[:2], (x, y)) < 5e-3
    assert vertical_extent(body)[0] == pytest.approx(SHEET_M, abs=5e-4)


# -- states ------------------------------------------------------------------------------------


def test_a_failure_is_part_of_the_state(make):
    env = make()
    task = env.scene.task
    kept = env.get_state()
    for body, y in zip(task.tubes, (0.06, -0.06), strict=False):
        lay(task, body, task.layout.test_area, (0.0, y))
    wait(env)
    failed = env.get_state()
    env.reset(kept, set_state=True)
    assert not task.has_failed
    assert not wait(env)["done"]
    assert env.reset(failed, set_state=True)["terminated"]
    assert task.has_failed
    env.reset()
    assert not task.has_failed


def test_the_vector_observation_keeps_entries_for_hidden_swabs(make):
    env = make(obs_type="vec")
    before = follow(env, 3)["observation"]
    after = follow(env, 1)["observation"]  # the first swab is removed
    assert before.shape == after.shape == (1 + 4 * (1 + 3 + 6),)
    swabs = after[-12:].reshape(3, 4)
    assert (swabs == torch.tensor([1.0, 1.0, 1.0, 0.0])).all(dim=1).sum() == 1
    assert after[5:].abs().max() <= 1.2
