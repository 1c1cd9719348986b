"""What the packing tasks share: sizes, containers, layouts, numbers of objects, experts."""

import itertools
import math

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.core.errors import ConfigError, PlacementError
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m
from ba_torchrl.tasks.open_loop.bin_packing import object_shapes
from ba_torchrl.tasks.packing.base import open_box
from ba_torchrl.tasks.packing.layout import Footprint, scatter
from ba_torchrl.testing import tasks as checks
from tests.tasks.episodes import play
from tests.tasks.packing.scenes import BIN, BOTTLES, BOXES


def test_an_open_box_holds_objects():
    with World() as world:
        size, wall, floor = (0.2, 0.1, 0.08), 0.004, 0.004
        box = world.add(open_box(size, wall, floor, (1.0, 1.0, 1.0, 1.0)), "box")
        box.place((0.0, 0.0, size[2] / 2))
        cube = world.add(object_shapes(1.0)["cube"], "cube")
        for x, y, z in ((0.0, 0.0, floor), (0.075, -0.025, floor), (0.2, 0.0, 0.0)):
            cube.place((x, y, 0.15))
            assert world.settle(400)
            assert cube.position == pytest.approx((x, y, z + 0.02), abs=1e-3)
        cube.place((0.098, 0.0, 0.11))  # its centre over a wall, which it must not pass through
        world.step(30)
        assert cube.position[2] > 0.08


def test_scattered_objects_keep_clearance(make_env):
    env = make_env(BIN)
    env.reset()
    task = env.scene.task
    fixed = Rectangle(0.45, 0.0, 0.4, 0.08, 0.07)
    footprints = [Footprint(0.02, 0.04, 0.06, 0.016)] * 6
    for seed in range(5):
        places = scatter(task, np.random.default_rng(seed), footprints, [fixed])
        bodies = [Rectangle(*xy, yaw, 0.02, 0.04) for xy, yaw in places]
        for a, b in itertools.combinations([fixed, *bodies], 2):
            assert gap_m(a, b) >= 0.005
        for a, b in itertools.permutations(bodies, 2):  # every object can be grasped
            assert gap_m(a.resized(0.06, 0.016), b) >= 0
    with pytest.raises(PlacementError, match="no room for 60"):
        scatter(task, np.random.default_rng(0), footprints * 10)


@pytest.mark.parametrize(
    ("task", "number", "message"),
    [
        (BIN, 11, "num_objects"),
        (BOTTLES, 5, "num_objects"),
        (BOXES, 7, "6, 12 or 18, not 7"),
        (BOXES, 24, "num_objects"),
        (BOXES, 1, "num_objects"),
    ],
)
def test_unsupported_numbers_of_objects_are_refused(task, number, message):
    with pytest.raises(ConfigError, match=message):
        ba_torchrl.make(task, num_objects=number)


SIX_DOF = {"action_sequence": "pxyzrrr"}


@pytest.mark.parametrize(
    ("task", "config", "optimum"),
    [
        (BOXES, {"num_objects": 6, **SIX_DOF}, 12),
        # every second layer needs the yaw
        (BOXES, {"num_objects": 6, "random_orientation": False, "action_sequence": "pxy"}, 12),
    ],
)
def test_the_expert_takes_the_fewest_steps(task, config, optimum):
    checks.check_expert(task, episodes=4, min_success_rate=1.0, max_typical_steps=optimum, **config)


@pytest.mark.parametrize(
    ("task", "config"),
    [
        (BIN, {"robot": "panda", "num_objects": 3}),
        (BOTTLES, {"robot": "ur5"}),
        (BOXES, {"robot": "ur5_robotiq"}),
    ],
)
def test_the_expert_succeeds_with_other_robots(task, config):
    checks.check_expert(task, episodes=1, min_success_rate=1.0, **config)


@pytest.mark.parametrize(("task", "least"), [(BIN, 0.7), (BOXES, 0.9)])
def test_the_expert_recovers_from_noisy_actions(make_env, task, least):
    env = make_env(task, obs_size=128, num_objects=6, max_steps=60)
    space = env.action_spec.space
    outcomes = []
    for episode in range(8):
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
            outcomes.append(bool(play(env, state)["success"]))
    # an object that lies against the outside of the bin leaves no clearance for a finger
    assert len(outcomes) >= 5
    assert np.mean(outcomes) >= least, outcomes


@pytest.mark.parametrize("task_id", [BIN, BOTTLES, BOXES])
def test_the_next_site_is_the_same_if_the_container_is_turned_by_half_a_turn(make_env, task_id):
    env = make_env(task_id, expert=True)
    state = env.reset()
    task = env.scene.task
    for _ in range(5):
        state["action"] = state["expert_action"]
        state = env.step(state)["next"]
        if not state["holding"]:
            continue
        before = task.expert_command()
        *position, yaw = *task.container.position, task.container.yaw_rad
        task.container.place(position, yaw + math.pi)
        after = task.expert_command()
        assert after[1:3] == pytest.approx(before[1:3], abs=2e-3)
        assert math.sin(after.rz_rad - before.rz_rad) == pytest.approx(0.0, abs=0.02)
