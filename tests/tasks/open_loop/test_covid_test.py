"""Covid Test: the layout, the order of the tests, what breaks it, and the expert."""

import itertools
import math

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.geometry import downward
from ba_torchrl.tasks.open_loop.covid_test import NEW_BOX, SHEET_M, TEST_AREA, USED_BOX, WALL_M

TASK = "open_loop/covid_test"
FIXED = {"random_orientation": False, "action_sequence": "pxy"}


@pytest.fixture
def make():
    envs = []

    def build(**config):
        env = ba_torchrl.make(TASK, **{"obs_size": 32, "seed": 0, "expert": True, **config})
        env.reset()
        envs.append(env)
        return env

    yield build
    for env in envs:
        env.close()


def step(env, action):
    """Take a step; an array or a command."""
    if isinstance(action, PickPlaceCommand):
        action = env.actions.encode(action)
    return env.step(env.full_action_spec.zero().set("action", torch.as_tensor(action)))["next"]


def wait(env):
    """Take a step that moves nothing: a place with nothing in the hand."""
    assert env.scene.task.robot.held_body() is None
    return step(env, PickPlaceCommand(PLACE, 0.3, 0.0, 0.1))


def follow(env, count):
    """Let the expert act; return the last step."""
    for _ in range(count):
        state = step(env, env._expert_action(env.scene))
    return state


def lay(task, body, area, spot, along=math.pi / 2):
    """Put a tube or swab on the floor of an area; spot and direction are in the area's frame."""
    task._lay(body, task._to_world(area, spot), area.yaw_rad + along)


def outline(task, area, size):
    """Return the corners of an area."""
    signs = itertools.product((-0.5, 0.5), repeat=2)
    return np.array([task._to_world(area, (s * size[0], t * size[1])) for s, t in signs])


def pair(task, tube=0, swab=0):
    """Lay a tube and a swab into the test area."""
    lay(task, task.tubes[tube], task.test_area, (0.0, 0.06))
    lay(task, task.swabs[swab], task.test_area, (0.0, -0.06))


# -- what there is -----------------------------------------------------------------------------


def test_sizes_are_the_papers(make):
    task = make().scene.task
    for bodies, size in ((task.tubes, (0.08, 0.017, 0.017)), (task.swabs, (0.07, 0.01, 0.01))):
        assert [body.shape.size_m for body in bodies] == [pytest.approx(size)] * 3
    assert make().max_steps == 30


def test_layouts_are_random_adjacent_and_inside_the_workspace(make):
    env = make()
    yaws, sides, centers = [], [], []
    for _ in range(60):
        env.reset()
        task = env.scene.task
        areas = ((task.new_box, NEW_BOX), (task.used_box, USED_BOX), (task.test_area, TEST_AREA))
        corners = {area: outline(task, area, spec.size) for area, spec in areas}
        for points in corners.values():
            assert (points >= (0.25 - 1e-9, -0.2 - 1e-9)).all()
            assert (points <= (0.65 + 1e-9, 0.2 + 1e-9)).all()
        for one, other in ((task.new_box, task.used_box), (task.new_box, task.test_area)):
            near = np.linalg.norm(corners[one][:, None] - corners[other][None], axis=-1).min()
            assert near < 0.06
        assert len({area.yaw_rad for area, _ in areas}) == 1
        yaws.append(task.new_box.yaw_rad)
        centers.append(task.test_area.position[:2])
        x, _ = local(task.new_box, task.test_area.position)
        assert abs(x) == pytest.approx(0.1525, abs=1e-6)
        sides.append(x > 0)
    quarters = np.round(np.array(yaws) / (math.pi / 2)).astype(int) % 4
    assert set(quarters) == {0, 1, 2, 3}
    off = np.degrees((np.array(yaws) + math.pi / 4) % (math.pi / 2) - math.pi / 4)
    assert 15 < np.abs(off).max() <= 18.5
    assert {True, False} == set(sides)  # mirrored or not
    assert np.ptp(centers, axis=0).min() > 0.15


def local(area, point):
    """Return x and y of a point in an area's frame."""
    dx, dy = (p - a for p, a in zip(point[:2], area.position[:2], strict=True))
    cos, sin = math.cos(area.yaw_rad), math.sin(area.yaw_rad)
    return cos * dx + sin * dy, cos * dy - sin * dx


def test_tubes_and_swabs_start_apart_on_the_floor_of_their_box(make):
    env = make()
    for _ in range(20):
        env.reset()
        task = env.scene.task
        assert len(task.objects) == 6
        for body in task.objects:
            x, y = local(task.new_box, body.position)
            assert abs(x) < NEW_BOX.size[0] / 2 - WALL_M
            assert abs(y) < NEW_BOX.size[1] / 2 - WALL_M
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
        yaws.add(round(abs(task.new_box.yaw_rad), 6))
        for body in task.objects:
            assert body.yaw_rad == pytest.approx(math.pi / 2, abs=1e-2)
    assert yaws == {0.0, round(math.pi, 6)}


def test_objects_that_do_not_fit_their_box_are_refused():
    with pytest.raises(ConfigError, match="object_scale_range"):
        ba_torchrl.make(TASK, object_scale_range=0.8)


# -- the order of the tests --------------------------------------------------------------------


def test_a_pair_in_the_test_area_becomes_a_test(make):
    env = make()
    task = env.scene.task
    pair(task, tube=1, swab=2)
    before = env._heightmap(env.scene)
    state = wait(env)
    assert not state["done"]
    assert task.get_state().used == (1,)
    assert task.get_state().spent == (2,)
    assert task.swabs[2].is_hidden
    assert task.swabs[2] not in task.objects
    assert len(task.objects) == 5
    x, y = local(task.test_area, task.tubes[1].position)
    assert abs(x) < 0.0126
    assert abs(y) < 0.1001
    assert (x, y) != pytest.approx((0.0, 0.06), abs=1e-3)  # it lies elsewhere
    assert env.scene.world.is_still()
    after = env._heightmap(env.scene)
    lost = (before > 0.006).sum() - (after > 0.006).sum()
    assert lost == pytest.approx(0.07 * 0.01 / env.pixel_m**2, rel=0.35)  # the swab's own pixels


def test_the_order_of_swab_and_tube_does_not_matter_and_one_alone_does_nothing(make):
    for first, second in ((0, 1), (1, 0)):
        env = make()
        task = env.scene.task
        bodies, spots = (task.tubes[0], task.swabs[0]), ((0.0, 0.06), (0.0, -0.06))
        lay(task, bodies[first], task.test_area, spots[first])
        assert not wait(env)["done"]
        assert task.get_state()[1:] == ((), (), False)
        lay(task, bodies[second], task.test_area, spots[second])
        assert not wait(env)["done"]
        assert task.get_state()[1:] == ((0,), (0,), False)


def test_where_used_tubes_turn_up_is_random_and_follows_from_the_seed(make):
    spots = []
    for seed in (0, 1, 2, 0):
        env = make(seed=seed)
        task = env.scene.task
        pair(task)
        wait(env)
        spots.append((*local(task.test_area, task.tubes[0].position), task.tubes[0].yaw_rad))
    assert spots[0] == spots[3]
    assert len(set(spots)) == 3


def test_a_used_tube_turns_up_beside_what_is_in_its_way(make):
    env = make()
    task = env.scene.task
    for attempt in range(6):
        env.reset()
        pair(task)
        # not in the test area by their middles, but reaching far into it from the outside
        side = math.copysign(0.0585, local(task.new_box, task.test_area.position)[0])
        lay(task, task.tubes[1], task.test_area, (side, 0.03), along=0.0)
        lay(task, task.tubes[2], task.test_area, (side, -0.03), along=0.0)
        where = [tube.position for tube in task.tubes[1:]]
        assert not wait(env)["done"], attempt
        assert task.get_state().used == (0,)
        for tube, position in zip(task.tubes[1:], where, strict=True):
            assert math.dist(tube.position, position) < 2e-3
        assert vertical_extent(task.tubes[0])[0] == pytest.approx(SHEET_M, abs=5e-4)


def test_what_is_held_above_the_test_area_is_not_presented(make):
    env = make()
    task = env.scene.task
    follow(env, 1)
    held = task.robot.held_body()
    assert held in task.tubes
    x, y = task._to_world(task.test_area, (0.0, 0.0))
    joints = task.robot.inverse_kinematics((x, y, 0.1), downward(0.0))
    env.scene.controller._teleport(joints)
    env.scene.world.step(2)
    assert math.dist(held.position[:2], (x, y)) < 0.02
    assert task.robot.held_body() is held
    assert not task._is_presented(held)


def test_a_swab_on_its_own_way_is_no_failure(make):
    env = make()
    task = env.scene.task
    lay(task, task.swabs[0], task.used_box, (0.0, 0.0), along=0.0)
    assert not wait(env)["done"]


# -- what breaks the order ---------------------------------------------------------------------


def expect_failure(env):
    state = wait(env)
    assert env.scene.task.has_failed
    assert state["terminated"]
    assert state["done"]
    assert not state["truncated"]
    assert not state["success"]
    assert state["reward"] == 0.0


@pytest.mark.parametrize("kind", ["tubes", "swabs"])
def test_two_of_a_kind_in_the_test_area_fail(make, kind):
    env = make()
    task = env.scene.task
    for body, y in zip(getattr(task, kind), (0.06, -0.06), strict=False):
        lay(task, body, task.test_area, (0.0, y))
    expect_failure(env)


def test_two_swabs_and_a_tube_fail(make):
    env = make()
    task = env.scene.task
    pair(task)
    lay(task, task.swabs[1], task.test_area, (0.03, -0.06))
    expect_failure(env)


def test_a_swab_beside_an_uncollected_used_tube_fails(make):
    env = make()
    task = env.scene.task
    pair(task)
    assert not wait(env)["done"]
    lay(task, task.tubes[0], task.test_area, (0.0, 0.06))
    lay(task, task.swabs[1], task.test_area, (0.0, -0.06))
    expect_failure(env)


def test_a_fresh_tube_beside_an_uncollected_used_tube_fails(make):
    env = make()
    task = env.scene.task
    pair(task)
    assert not wait(env)["done"]
    lay(task, task.tubes[0], task.test_area, (0.0, 0.06))
    lay(task, task.tubes[1], task.test_area, (0.0, -0.06))
    expect_failure(env)


@pytest.mark.parametrize("where", ["new_box", "across the rim", "beside"])
def test_a_pair_before_the_used_tube_is_in_its_box_fails(make, where):
    env = make()
    task = env.scene.task
    pair(task)
    assert not wait(env)["done"]
    put_wrong(task, task.tubes[0], where)
    assert not wait(env)["done"]  # it may be carried about
    pair(task, 1, 1)
    expect_failure(env)


def put_wrong(task, tube, where):
    """Put a used tube where it does not belong."""
    if where == "new_box":
        lay(task, tube, task.new_box, (0.0, 0.04))
    elif where == "across the rim":  # a bridge over the corner, its middle above the inside
        rim = USED_BOX.size[2] + tube.shape.size_m[2] / 2
        x, y = task._to_world(task.used_box, (0.037, 0.027))
        tube.place((x, y, rim), task.used_box.yaw_rad - math.atan2(0.046, 0.056))
    else:
        lay(task, tube, task.used_box, (0.0, 0.064), along=0.0)


def test_a_collected_tube_is_not_tested_again(make):
    env = make()
    task = env.scene.task
    pair(task)
    wait(env)
    lay(task, task.tubes[0], task.used_box, (0.0, 0.0), along=0.0)
    assert not wait(env)["done"]
    pair(task, 0, 1)
    expect_failure(env)


def test_what_leaves_the_workspace_ends_the_episode(make):
    env = make()
    task = env.scene.task
    task.swabs[0].place((0.7, 0.0, 0.005), 0.0)
    state = wait(env)
    assert state["terminated"]
    assert not state["success"]
    assert not task.has_failed


# -- the goal ----------------------------------------------------------------------------------


def make_tests(env, rounds=3):
    """Make tests one after the other, the used tubes side by side in their box."""
    task = env.scene.task
    for i in range(rounds):
        pair(task, i, i)
        state = wait(env)
        assert not state["done"]
        assert len(task.get_state().used) == i + 1
        if i < rounds - 1:
            lay(task, task.tubes[i], task.used_box, (0.0, 0.024 * i - 0.024), along=0.0)
    return task


def test_three_used_tubes_in_their_box_are_a_success(make):
    env = make()
    task = make_tests(env)
    assert not task.is_success()
    lay(task, task.tubes[2], task.used_box, (0.0, 0.024), along=0.0)
    state = wait(env)
    assert state["success"]
    assert state["terminated"]
    assert state["reward"] == 1.0


@pytest.mark.parametrize("where", ["new_box", "across the rim", "beside", "test area"])
def test_the_last_tube_elsewhere_is_none(make, where):
    env = make()
    task = make_tests(env)
    if where != "test area":
        put_wrong(task, task.tubes[2], where)
    state = wait(env)
    assert not state["success"]
    assert not state["done"]


def test_a_tube_across_the_rim_is_not_in_the_box(make):
    env = make()
    task = make_tests(env)
    put_wrong(task, task.tubes[2], "across the rim")
    wait(env)
    x, y = local(task.used_box, task.tubes[2].position)
    assert abs(x) < USED_BOX.size[0] / 2 - WALL_M
    assert abs(y) < USED_BOX.size[1] / 2 - WALL_M
    assert vertical_extent(task.tubes[2])[0] > USED_BOX.size[2] - 2e-3
    assert not task.is_collected(task.tubes[2])


def test_fresh_tubes_in_the_box_for_used_ones_are_none(make):
    env = make()
    task = env.scene.task
    for tube, y in zip(task.tubes, (-0.024, 0.0, 0.024), strict=True):
        lay(task, tube, task.used_box, (0.0, y), along=0.0)
    assert all(map(task.is_collected, task.tubes))
    state = wait(env)
    assert not state["success"]
    assert not state["done"]


def test_a_tube_in_the_gripper_is_not_collected(make):
    env = make()
    task = make_tests(env)
    follow(env, 1)
    assert task.robot.held_body() is task.tubes[2]
    assert not task.is_success()
    assert follow(env, 1)["success"]


# -- states ------------------------------------------------------------------------------------


def poses(env):
    return [body.pose for body in env.scene.world.bodies]


def advance(env, state, count):
    """Let the expert act from a state on; return every state."""
    states = [state]
    for _ in range(count):
        states.append(step(env, states[-1]["expert_action"]))
    return states[1:]


def test_a_state_keeps_the_task_the_hidden_swabs_and_the_future(make):
    env = make(seed=4)
    state = follow(env, 3)  # a tube is presented, a swab held
    task, motion = env.scene.task, env.scene.controller
    swab = motion.held
    assert swab in task.swabs
    kept = env.get_state()
    first = advance(env, state, 3)
    assert swab.is_hidden
    assert task.get_state().spent == (task.swabs.index(swab),)
    later = env.get_state()
    there = poses(env), task.get_state()
    env.set_state(kept)
    assert motion.held is swab
    assert swab.is_hidden
    assert task.get_state().spent == ()
    assert swab in task.objects
    env.set_state(later)  # while it is in the gripper
    assert motion.held is not swab
    assert swab.is_hidden
    assert swab not in task.objects
    assert (poses(env), task.get_state()) == there
    for before in (kept, later):  # back from before the test, and from after it
        env.set_state(before)
        second = advance(env, env.set_state(kept), 3)
        for one, other in zip(first, second, strict=True):
            torch.testing.assert_close(one["pixels"], other["pixels"], atol=1e-3, rtol=0)
        assert task.get_state() == there[1]
        where = [body.position for body in task.objects]
        assert where == [
            pytest.approx(pose[0], abs=1e-3)
            for body, pose in zip(env.scene.world.bodies, there[0], strict=True)
            if body in task.objects
        ]
    env.reset()
    assert not any(body.is_hidden for body in env.scene.world.bodies)
    returned = env.set_state(later)
    assert torch.equal(returned["pixels"], first[-1]["pixels"])
    assert swab.is_hidden


def test_a_failure_is_part_of_the_state(make):
    env = make()
    task = env.scene.task
    kept = env.get_state()
    for body, y in zip(task.tubes, (0.06, -0.06), strict=False):
        lay(task, body, task.test_area, (0.0, y))
    wait(env)
    failed = env.get_state()
    env.set_state(kept)
    assert not task.has_failed
    assert not wait(env)["done"]
    assert env.set_state(failed)["terminated"]
    assert task.has_failed
    env.reset()
    assert not task.has_failed


def test_the_same_seed_has_the_same_episode(make):
    first, second = make(seed=7), make(seed=7)
    while True:
        a, b = (follow(env, 1) for env in (first, second))
        assert torch.equal(a["pixels"], b["pixels"])
        assert poses(first) == poses(second)
        if a["done"]:
            break
    assert a["success"]


def test_the_vector_of_poses_has_a_place_for_every_swab(make):
    env = make(obs_type="vec")
    before = follow(env, 3)["observation"]
    after = follow(env, 1)["observation"]  # the first swab is gone
    assert before.shape == after.shape == (1 + 4 * (1 + 3 + 6),)
    swabs = after[-12:].reshape(3, 4)
    assert (swabs == torch.tensor([1.0, 1.0, 1.0, 0.0])).all(dim=1).sum() == 1
    assert after[5:].abs().max() <= 1.2


# -- the expert --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [307, 312, 317])
def test_the_expert_leaves_what_lies_against_a_wall_for_last(make, seed):
    env = make(max_steps=60)
    state, rng = env.reset(seed=seed), np.random.default_rng(seed - 300)
    for number in range(60):
        action = state["expert_action"].clone()
        if number < 6:
            action[1:3] += torch.tensor(rng.normal(0, 0.015, 2), dtype=torch.float32)
        state = env.step(state.set("action", action))["next"]
        if state["done"]:
            break
    assert not state["truncated"]


@pytest.mark.parametrize(
    "config",
    [{}, FIXED, {"action_sequence": "pxyzrrr"}],
    ids=["pxyr", "pxy", "pxyzrrr"],
)
def test_the_expert_succeeds_in_eighteen_steps(make, config):
    env = make(obs_size=128, **config)
    lengths = []
    for _ in range(6):
        env.reset()
        state = follow(env, 1)
        while not state["done"]:
            state = follow(env, 1)
        assert state["success"]
        lengths.append(int(state["step_count"]))
    assert np.median(lengths) == 18
    assert env.faults == 0


def finish(env):
    for _ in range(env.max_steps):
        state = follow(env, 1)
        if state["done"]:
            return state
    return state


def test_the_expert_goes_on_after_mistakes(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    pair(task)
    wait(env)
    lay(task, task.tubes[0], task.new_box, (0.0, -0.01), along=0.2)
    assert finish(env)["success"]


def test_the_expert_puts_back_what_it_must_not_present(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    pair(task)
    wait(env)
    for body in (task.tubes[1], task.swabs[1]):
        x, y, z = body.position
        step(env, PickPlaceCommand(PICK, x, y, z + 0.003, body.yaw_rad + math.pi / 2))
        assert task.robot.held_body() is body
        follow(env, 1)
        assert task.robot.held_body() is None
        x, y = local(task.new_box, body.position)
        assert abs(x) < NEW_BOX.size[0] / 2
        assert abs(y) < NEW_BOX.size[1] / 2
    assert not task.has_failed
    assert finish(env)["success"]


def test_the_expert_takes_a_fresh_tube_out_of_the_wrong_box(make):
    env = make(obs_size=128, max_steps=40)
    task = env.scene.task
    lay(task, task.tubes[1], task.used_box, (0.0, 0.0), along=0.0)
    assert finish(env)["success"]


def test_asking_the_expert_when_all_is_done_changes_nothing(make):
    env = make()
    task = make_tests(env)
    lay(task, task.tubes[2], task.used_box, (0.0, 0.024), along=0.0)
    assert wait(env)["success"]
    command = task.expert_command()
    assert command == task.expert_command()
    where = [tube.position for tube in task.tubes]
    step(env, command)
    assert [tube.position for tube in task.tubes] == [pytest.approx(p, abs=1e-3) for p in where]
    assert task.is_success()


# -- heights -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tubes", "swabs"])
def test_heights_from_the_image_suit_thin_things(make, kind):
    env = make(obs_size=128)
    task = env.scene.task
    body = getattr(task, kind)[1]
    x, y, _ = body.position
    step(env, PickPlaceCommand(PICK, x, y, None, body.yaw_rad + math.pi / 2))
    assert task.robot.held_body() is body
    x, y = task._to_world(task.test_area, (0.0, 0.03))
    seen = []
    place = env.scene.controller.place
    env.scene.controller.place = lambda position, turn: (
        seen.append(position),
        place(position, turn),
    )
    tool, _ = task.robot.tool_pose()
    below = tool[2] - vertical_extent(body)[0]
    step(env, PickPlaceCommand(PLACE, x, y, None, 0.0))
    gap = seen[0][2] - below - SHEET_M
    assert 0 < gap < 0.011  # at most the low rim next to the test area is looked over
    assert math.dist(body.position[:2], (x, y)) < 5e-3
    assert vertical_extent(body)[0] == pytest.approx(SHEET_M, abs=5e-4)


def test_picking_a_tube_leaves_its_neighbours_where_they_are(make):
    env = make(obs_size=128)
    for _ in range(5):
        env.reset()
        task = env.scene.task
        where = {body: body.position for body in task.objects}
        follow(env, 1)
        held = task.robot.held_body()
        assert held in task.tubes
        for body, position in where.items():
            if body is not held:
                assert math.dist(body.position, position) < 1e-3
