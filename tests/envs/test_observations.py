"""Observations that are enabled by name: gripper, joints, cameras, segmentation, instruction."""

import copy
import functools
import itertools
import pickle

import numpy as np
import pytest
import torch
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.gym import GymEnv
from ba_torchrl.envs.observations import OBSERVATIONS
from ba_torchrl.sim.geometry import Pose, quaternion_matrix
from ba_torchrl.tasks.instructions import color_name
from tests.specs import slow_except_two_robots
from tests.tasks.episodes import follow_expert

PICKING = "close_loop/block_picking"
GRASPING = "close_loop/object_grasping"
CAMERAS = ("wrist_rgb", "segmentation")
SETTINGS = {"obs_size": 32, "seed": 0}


@pytest.fixture
def make(make):
    return lambda task, *names, **settings: make(task, observations=list(names), **settings)


def test_all_observations_together_follow_their_specs(make):
    names = ("proprio", "joints", *CAMERAS, "instruction")
    env = make("open_loop/house_building_2", *names, rgb=True, camera_size=40)
    check_env_specs(env)
    state = env.reset()
    assert state["heightmap"].shape == (1, 32, 32)
    assert state["rgb"].shape == state["wrist_rgb"].shape == (3, 40, 40)
    assert state["rgb_depth"].shape == state["segmentation"].shape == (1, 40, 40)
    assert env.vectors == {"proprio": 8, "joints": 7}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"joints": torch.zeros(3)}, r"joints has torch.float32 \[3\], its .* torch.float32 \[7\]"),
        ({"joints": torch.zeros(7).double()}, "joints has torch.float64"),
        ({"joints": np.zeros(7, np.float32)}, "joints has float32"),
        ({"joints": 0.0}, "joints has <class 'float'>"),
        ({"angles": torch.zeros(7)}, "angles, joints is either observed or specified"),
    ],
)
def test_an_observation_that_is_not_as_specified_is_refused(make, monkeypatch, entries, message):
    monkeypatch.setattr(OBSERVATIONS["joints"], "observe", lambda self, scene: entries)
    with pytest.raises(ConfigError, match=message):
        make(PICKING, "joints").reset()


def test_proprioception_is_the_tools_pose_and_the_opening(make):
    env = make(PICKING, "proprio", "joints", expert=True)
    state = env.reset()
    for _ in range(5):
        robot, (pose, opening) = env.scene.robot, (state["proprio"][:7], state["proprio"][7])
        tool = robot.tool_frame()
        seen = Pose(tuple(pose[:3].tolist()), tuple(pose[3:].tolist()))
        np.testing.assert_allclose(seen.position, tool.position, atol=1e-6)
        rotations = (quaternion_matrix(each.orientation) for each in (seen, tool))
        np.testing.assert_allclose(*rotations, atol=1e-6)
        assert opening == pytest.approx(robot.opening())
        assert state["joints"].tolist() == pytest.approx(robot.measured_joints())
        state = follow_expert(env, state)
    assert opening < 0.9


@pytest.mark.parametrize("turn", [-1.0, 1.0])
def test_the_quaternion_of_a_gripper_that_points_down_is_continuous(make, turn):
    env = make(PICKING, "proprio", action_sequence="pxyzr", max_steps=10)
    state, seen = env.reset(), []
    action = torch.tensor([1.0, 0.0, 0.0, 0.0, turn])
    for _ in range(3):  # up to 135 degrees
        seen.append(state["proprio"][3:7])
        state = env.step(state.set(keys.ACTION, action))[keys.NEXT]
    for before, after in itertools.pairwise(seen):
        assert before @ after == pytest.approx(np.cos(np.pi / 8), abs=0.01)
    assert all(quaternion[0] > 0 for quaternion in seen)


def red_share(image):
    red, green, blue = image.int().unbind(0)
    return ((red > 2 * green) & (red > 2 * blue)).float().mean()


@pytest.mark.parametrize("robot", slow_except_two_robots())
def test_the_wrist_camera_sees_what_is_between_the_fingertips(make, robot):
    env = make("open_loop/block_stacking", "wrist_rgb", expert=True, robot=robot, camera_size=64)
    state = env.reset()
    middle = (slice(None), slice(12, 44), slice(22, 42))
    assert red_share(state["wrist_rgb"][middle]) < 0.02
    state = follow_expert(env, state)
    assert state[keys.HOLDING]
    assert red_share(state["wrist_rgb"][middle]) > 0.1


def test_the_wrist_camera_turns_with_the_gripper(make):
    env = make(PICKING, "wrist_rgb", camera_size=64)
    state = env.reset()
    first = state["wrist_rgb"]
    turned = env.step(state.set(keys.ACTION, torch.tensor([1.0, 0, 0, 0, 0.5])))[keys.NEXT]
    dark = []
    for image in (first.int(), turned["wrist_rgb"].int()):
        is_gray = image.amax(0) - image.amin(0) < 12
        dark.append(is_gray & (image.amax(0) < 200))
    assert dark[0].float().mean() > 0.1  # the fingers
    assert (dark[0] == dark[1]).float().mean() > 0.97  # stay where they are
    assert not torch.equal(first, turned["wrist_rgb"])


@pytest.mark.parametrize(
    "task", ["close_loop/block_stacking", "close_loop/drawer_opening", "open_loop/bin_packing"]
)
def test_segmentation_names_the_bodies_that_pybullet_projects(make, task):
    env = make(task, "segmentation", rgb=True, camera_size=96)
    state = env.reset()
    segmentation, names = state["segmentation"][0], env.segmentation_names
    assert names[:2] == ("background", "robot")
    assert len(set(names)) == len(names)
    scene = env.scene
    visible = set(segmentation.flatten().tolist())
    assert {0, 1} <= visible
    for body in scene.world.bodies:  # links of a body are told apart
        assert (names.index(body.name) in visible) == (not body.is_inactive), body.name
    if task == "close_loop/block_stacking":  # a red and a blue cube
        red, green, blue = state["rgb"].int().unbind(0)
        colors = {"cube 1": (red > 2 * green) & (red > 2 * blue), "cube 2": blue > 2 * red}
        for name, expected in colors.items():
            found = segmentation == names.index(name)
            assert (found & expected).sum() > 0.85 * max(found.sum(), 20)


def test_options_change_no_other_entry(make):
    plain = make(PICKING, expert=True)
    rich = make(PICKING, "proprio", "joints", "instruction", *CAMERAS, expert=True)
    state, other = plain.reset(), rich.reset()
    for _ in range(4):
        assert set(state.keys()) < set(other.keys())
        assert all(torch.equal(value, other[key]) for key, value in state.items())
        state, other = follow_expert(plain, state), follow_expert(rich, other)


# -- instructions ------------------------------------------------------------------------------


def test_every_task_tells_the_objects_of_its_goal():
    told = {task: ba_torchrl.describe(task).instruction for task in WORDS}
    for task, words in WORDS.items():
        assert told[task] == words


WORDS = {
    "close_loop/block_stacking": "stack the red cube and the blue cube",
    "close_loop/block_pushing": "push the red block onto the green square",
    "close_loop/drawer_opening": "open the drawer of the brown cabinet",
    "open_loop/block_stacking": "stack the four red cubes",
    "open_loop/house_building_1": "stack the three red cubes and put the green triangle on top",
    "open_loop/house_building_4": (
        "put the blue cuboid across two red cubes, then put the other two red cubes on top, then "
        "put the green roof across them"
    ),
    "open_loop/box_palletizing": "stack the eighteen beige boxes on the brown pallet",
    "ramp/improvise_house_building_2": (
        "put the green roof across the two orange objects, between the ramps"
    ),
}


@pytest.mark.parametrize(
    ("color", "name"),
    [
        ((0.3, 0.3, 0.3), "gray"),
        ((0.8, 0.8, 0.8), "gray"),
        ((0.05, 0.05, 0.05), "black"),
        ((1.0, 1.0, 1.0), "white"),
        ((0.5, 0.0, 0.0), "red"),
        ((0.0, 0.0, 0.3), "blue"),
    ],
)
def test_dark_and_gray_colours_have_their_names(color, name):
    assert color_name((*color, 1.0)) == name


def test_a_copy_has_the_instruction(make):
    env = make("open_loop/block_stacking", num_objects=2, object_type="cylinder")
    env.reset()
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert other.instruction == env.instruction == "stack the two orange cylinders"
        other.close()


@pytest.mark.parametrize("names", [("rgb",), ("wrist_rgb",), ("segmentation", "vec")])
def test_each_camera_has_the_given_size(make, names):
    spec = make(PICKING, *names, camera_size=24).observation_spec
    assert spec[names[0]].shape[-2:] == (24, 24)


@pytest.mark.parametrize("names", [(), ("proprio", "joints", "instruction")])
def test_the_size_of_a_camera_that_is_not_observed_is_refused(make, names):
    with pytest.raises(ConfigError, match=r"camera_size has no effect .*'segmentation'"):
        make(PICKING, *names, camera_size=64)


def test_an_instruction_follows_the_parameters_and_the_episode(make):
    env = make("open_loop/block_stacking", num_objects=2, object_type="cylinder")
    env.reset()
    assert env.instruction == "stack the two orange cylinders"
    heap = make(GRASPING, "instruction", expert=True, num_objects=2, random_orientation=False)
    state, told = heap.reset(), []
    saved = heap.get_state()
    while len(told) < 2:
        told.append(state["instruction"])
        while not state[keys.DONE]:
            state = follow_expert(heap, state)
        assert state["instruction"] == told[-1] == heap.instruction
        assert state[keys.SUCCESS]
        state = heap.reset()
    assert told == ["pick up one of the two objects in the tray", "pick up the object in the tray"]
    assert heap.reset(saved, set_state=True)["instruction"] == heap.instruction == told[0]


def test_gymnasium_has_the_instruction_in_info():
    env = GymEnv(PICKING, obs_size=32, observations=["instruction", "proprio"])
    try:
        observation, info = env.reset(seed=0)
        assert info["instruction"] == env.instruction == "pick up the red block"
        assert set(observation) == {"depth", "holding", "proprio"}
        assert env.step(env.action_space.sample())[-1]["instruction"] == "pick up the red block"
        assert env.observation_space.contains(observation)
    finally:
        env.close()


HEAP = {**SETTINGS, "observations": ["instruction"], "expert": True, "num_objects": 2}


def make_heap(seed):
    return ba_torchrl.make(GRASPING, **{**HEAP, "seed": seed})


@pytest.mark.parametrize(
    "kind", [pytest.param("serial", marks=pytest.mark.slow), "parallel", "torchrl"]
)
def test_vectors_return_the_instruction_of_each_episode(kind):
    """The heap of an environment has one object less after a success."""
    if kind == "torchrl":
        factories = [functools.partial(make_heap, seed) for seed in (0, 1)]
        envs = ParallelEnv(2, factories, mp_start_method="fork")
    else:
        options = {"parallel": kind == "parallel", "start_method": "fork"}
        envs = ba_torchrl.make_vector_env(GRASPING, 2, **options, **HEAP)
    try:
        state = envs.reset()
        assert list(state["instruction"]) == ["pick up one of the two objects in the tray"] * 2
        expected = list(state["instruction"])
        for _ in range(30):
            action = state[keys.EXPERT_ACTION]
            step, state = envs.step_and_maybe_reset(state.set(keys.ACTION, action))
            assert list(step[keys.NEXT, "instruction"]) == expected
            done = step[keys.NEXT, keys.DONE].flatten().tolist()
            now = list(state["instruction"])
            for i, is_done in enumerate(done):
                assert is_done or now[i] == expected[i]
            expected = now
            if any(done):
                break
        assert "pick up the object in the tray" in expected
        mask = torch.tensor([[True], [False]])
        after = list(envs.reset(state.set("_reset", mask))["instruction"])
        assert after[1] == expected[1]
    finally:
        envs.close()
