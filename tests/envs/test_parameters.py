"""Every parameter of `EnvConfig` has its documented effect (appendix B, table 4)."""

import itertools
import math
import pickle

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.env_config import CUSTOM_PHYSICS
from ba_torchrl.envs.observations import vector_names
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.sim.vision.camera_views import VIEWS
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.config import ExperimentConfig
from tests.specs import slow_except
from tests.tasks.episodes import play

PICKING = "close_loop/block_picking"
SETTINGS = {"obs_size": 32, "seed": 0}


def act(env, state, **components):
    """Take one step with the named components, the others zero and the gripper open."""
    sequence = env.actions.sequence
    action = torch.tensor([components.get(c, float(c == "p")) for c in sequence])
    return env.step(state.clone().set(keys.ACTION, action))[keys.NEXT]


def test_action_sequence_orders_the_components(make):
    poses = []
    for sequence in ("pxyzr", "rzyxp", "xyzpr"):
        env = make(action_sequence=sequence)
        act(env, env.reset(), x=0.5, y=-0.7, z=-0.2, r=0.6, p=-1.0)
        poses.append((*env.scene.robot.tool_pose()[0], env.scene.robot.tool_pose()[1]))
        assert env.scene.robot.opening() < 0.1
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-9)
    np.testing.assert_allclose(poses[2], poses[0], atol=1e-9)


def test_workspace_bounds_gripper_and_objects(make):
    env = make(workspace=((0.4, 0.58), (-0.08, 0.1), (0.01, 0.22)))
    state = env.reset()
    for _ in range(8):
        state = act(env, state, x=1.0, y=-1.0, z=1.0)
    np.testing.assert_allclose(env.scene.robot.tool_pose()[0], (0.58, -0.08, 0.22), atol=2e-3)
    for _ in range(10):
        env.reset()
        x, y, _ = env.scene.task.block.position
        assert 0.4 < x < 0.58
        assert -0.08 < y < 0.1


def test_obs_size_and_view_scale(make):
    for size in (32, 50):
        env = make(obs_size=size)
        assert env.reset()[keys.DEPTH].shape == (1, size, size)
    tops = []
    for view_scale in (1.0, 2.0):
        env = make(obs_size=128, view_scale=view_scale)
        depth = env.reset()[keys.DEPTH]
        tops.append(int(((depth < depth.max() - 0.03) & (depth > 0)).sum()))
    assert tops[0] == pytest.approx(4 * tops[1], rel=0.15)  # half the width, four times the area


def test_fast_mode_skips_physics_and_nothing_else(make):
    fast, slow = make(), make(fast_mode=False)
    states = fast.reset(), slow.reset()
    for env, state in zip((fast, slow), states, strict=True):
        act(env, state, x=1.0, z=-0.5, r=0.5)
    steps = [env.scene.world.steps for env in (fast, slow)]
    assert steps[1] > steps[0] + 10
    poses = [env.scene.robot.tool_pose() for env in (fast, slow)]
    np.testing.assert_allclose(poses[0][0], poses[1][0], atol=2e-3)
    assert poses[0][1] == pytest.approx(poses[1][1], abs=0.01)


def test_random_orientation(make):
    for random, spread in ((True, 0.2), (False, 0.0)):
        env = make(random_orientation=random)
        yaws = []
        for _ in range(20):
            env.reset()
            yaws.append(env.scene.task.block.yaw_rad)
        assert (np.std(yaws) > spread) if random else np.allclose(yaws, 0.0, atol=1e-3)


def test_half_rotation_keeps_the_yaw_within_a_half_turn(make):
    reached = {}
    for half in (False, True):
        env = make(half_rotation=half)
        state = env.reset()
        for _ in range(3):
            state = act(env, state, r=1.0)
        reached[half] = env.scene.robot.tool_pose()[1]
    assert reached[False] == pytest.approx(3 * math.pi / 4, abs=0.02)
    assert reached[True] == pytest.approx(math.pi / 2, abs=0.02)


@pytest.mark.parametrize(
    "task",
    slow_except(
        [task for task in TASKS if TASKS[task].control == "close_loop"],
        [PICKING, "close_loop/block_stacking", "close_loop/drawer_opening"],
    ),
)
def test_experts_stay_within_the_half_turn(make, task):
    env = make(task, half_rotation=True, expert=True)
    successes = 0
    for _ in range(5):
        successes += bool(play(env, env.reset())["success"])
    assert successes >= 4


@pytest.mark.parametrize("task", [PICKING, "open_loop/block_stacking"])
def test_workspace_check_uses_centres_or_bounding_boxes(make, task):
    for check, valid in (("point", True), ("bounding_box", False)):
        env = make(task, workspace_check=check)
        env.reset()
        env.scene.task.objects[0].place((env.workspace.x[1] - 5e-3, 0.0, 0.025))
        assert env.scene.task.is_valid() == valid


def test_in_hand_size_sets_the_size_of_in_hand_images(make):
    env = make("open_loop/block_stacking", in_hand_size=40, obs_size=64, expert=True)
    state = env.reset()
    assert state["in_hand"].shape == (1, 40, 40)
    state = env.step(state.set("action", state["expert_action"]))["next"]
    # a cube of 3 cm in the middle of an image of 40 pixels of 6.25 mm
    image = state["in_hand"][0]
    assert image[19:21, 19:21].min() == pytest.approx(0.03, abs=2e-3)
    assert 12 <= (image > 0.02).sum() <= 100


@pytest.mark.parametrize("task", TASKS)
def test_a_resolved_configuration_is_valid_and_complete(task):
    resolved = resolve_env(task, {"seed": 3})
    again = resolve_env(task, resolved.config.model_dump())
    assert again == resolved == pickle.loads(pickle.dumps(resolved))
    unset = {name for name, value in resolved.config.model_dump().items() if value is None}
    optional = {
        "camera_size",
        "floor_color",
        "workspace_color",
        *CUSTOM_PHYSICS,
        *TASKS[task].Parameters.model_fields,
    }
    if TASKS[task].control == "close_loop":
        optional |= {"in_hand_mode", "in_hand_size"}
    assert unset <= optional
    assert unset >= {"floor_color", *CUSTOM_PHYSICS}


def test_environments_are_made_from_resolved_parameters(make):
    resolved = resolve_env("open_loop/block_stacking", {"obs_size": 32})
    env = ba_torchrl.make(resolved, num_objects=8)
    assert (env.config.obs_size, env.max_steps) == (32, 14)  # the default of eight blocks
    env.close()
    vector = ba_torchrl.make_vector_env(resolved, 2, parallel=False, max_steps=3)
    assert vector.reset()["heightmap"].shape == (2, 1, 32, 32)
    vector.close()
    named = resolve_env(PICKING, {}, modules=["json"])
    assert pickle.loads(pickle.dumps(named)).modules == named.changed(seed=1).modules == ("json",)
    unset = resolve_env("open_loop/block_stacking", {"max_steps": None})
    assert unset.changed(num_objects=8).config.max_steps == 14
    assert resolved.given == {"obs_size": 32}


def test_a_pickle_imports_the_modules_of_its_parts_first(monkeypatch):
    imported = []
    run = {"task": PICKING, "algorithm": {"name": "sac"}, "network": {"name": "cnn"}}
    config = ExperimentConfig.parse({**run, "plugins": ["json"], "env": {"obs_size": 64}})
    monkeypatch.setattr("ba_torchrl.envs.settings.import_modules", imported.append)
    monkeypatch.setattr("ba_torchrl.training.config.load_plugins", imported.append)
    assert pickle.loads(pickle.dumps(config)) == config
    assert imported == [["json"], ("json",)]


def test_the_step_limit_grows_with_the_number_of_blocks(make):
    for count, limit in ((4, 10), (6, 10), (7, 12), (8, 14)):
        resolved = resolve_env("open_loop/block_stacking", {"num_objects": count})
        assert resolved.config.max_steps == limit
    env = make("open_loop/block_stacking", num_objects=7, expert=True)
    assert play(env, env.reset(seed=0))["success"]


def test_close_loop_tray_raises_the_objects_and_is_visible(make):
    env, plain = make(close_loop_tray=True, obs_size=64), make(obs_size=64)
    depths = env.reset()[keys.DEPTH], plain.reset()[keys.DEPTH]
    assert env.scene.task.block.position[2] == pytest.approx(0.027, abs=5e-4)
    assert plain.scene.task.block.position[2] == pytest.approx(0.025, abs=5e-4)
    assert not torch.equal(*depths)
    # the walls rise towards the border: less deep than the floor
    assert depths[0][0, 32, 6] < depths[1][0, 32, 6] - 0.02
    env = make(close_loop_tray=True, expert=True)
    assert all(play(env, env.reset())["success"] for _ in range(3))


def test_dpos_and_drot_bound_an_action(make):
    env = make(dpos=0.02, drot=math.pi / 8)
    state = env.reset()
    before = env.scene.robot.tool_pose()
    act(env, state, x=1.0, y=-1.0, r=1.0)
    after = env.scene.robot.tool_pose()
    np.testing.assert_allclose(np.subtract(after[0], before[0]), (0.02, -0.02, 0.0), atol=1e-3)
    assert after[1] - before[1] == pytest.approx(math.pi / 8, abs=5e-3)


def test_obs_type_vec_lists_scaled_poses(make):
    env = make("close_loop/block_pushing", obs_type="vec")
    state = env.reset()
    assert keys.DEPTH not in state
    task, robot = env.scene.task, env.scene.robot
    expected = {"opening": 2 * robot.opening() - 1}
    for owner, (position, yaw) in {
        "tool": robot.tool_pose(),
        "object_0": (task.block.position, task.block.yaw_rad),
        "object_1": (task.goal.position, task.goal.yaw_rad),
    }.items():
        low, high = np.array([0.3, -0.15, 0.01]), np.array([0.6, 0.15, 0.25])
        scaled = 2 * (np.array(position) - low) / (high - low) - 1
        expected |= {f"{owner}_{axis}": value for axis, value in zip("xyz", scaled, strict=True)}
        expected[f"{owner}_yaw"] = yaw / math.pi
    names = vector_names(2)
    found = dict(zip(names, state[keys.OBSERVATION].tolist(), strict=True))
    assert found == pytest.approx(expected, abs=1e-6)
    moved = act(env, state, x=1.0)[keys.OBSERVATION] - state[keys.OBSERVATION]
    assert moved[names.index("tool_x")] == pytest.approx(0.05 / 0.15, abs=5e-3)


def test_view_types_show_the_same_scene_differently(make):
    images = []
    for view in (
        "camera_center_xyz",
        "camera_center_xy_height",
        "render_center",
        "camera_side_rgbd",
    ):
        env = make("close_loop/block_pushing", view_type=view)
        images.append(act(env, env.reset(), x=0.6, r=0.7)[keys.DEPTH])
        assert images[-1].shape == (VIEWS[view].channels, 32, 32)
        assert env.observation_spec[keys.DEPTH].is_in(images[-1])
    for first, second in itertools.combinations(images, 2):
        assert first.shape != second.shape or not torch.equal(first, second)


def test_rgb_adds_an_image_and_its_depth(make):
    plain, env = make(), make(rgb=True, obs_size=48)
    assert keys.RGB not in plain.reset()
    state = env.reset()
    rgb, depth = state[keys.RGB], state[keys.RGB_DEPTH]
    assert rgb.shape == (3, 48, 48)
    assert rgb.dtype == torch.uint8
    assert depth.shape == (1, 48, 48)
    red = (rgb[0].int() - rgb[1].int() > 60) & (rgb[0].int() - rgb[2].int() > 60)
    assert red.sum() >= 4  # the block
    assert 0.4 < depth.min() < depth.max() < 5.0
    moved = act(env, state, x=1.0, y=1.0)
    assert not torch.equal(moved[keys.RGB], rgb)  # the arm is in it


def test_point_cloud_adds_points_on_the_surfaces(make):
    env = make(point_cloud=512)
    points = env.reset()[keys.POINT_CLOUD]
    assert points.shape == (512, 3)
    assert points.dtype == torch.float32
    block = torch.tensor(env.scene.task.block.position)
    near = (points[:, :2] - block[:2]).norm(dim=1) < 0.02
    assert points[near, 2].max() == pytest.approx(0.05, abs=2e-3)
    assert (points[:, 2] < 0.01).sum() > 100  # the floor


@pytest.mark.parametrize(
    ("settings", "time_step_s", "iterations"),
    [
        ({"physics_mode": "fast"}, 1 / 120, 50),
        ({"physics_mode": "slow"}, 1 / 240, 200),
        ({"physics_mode": "custom", "solver_iterations": 80}, 1 / 120, 80),
        ({"physics_mode": "custom", "time_step_s": 1 / 300}, 1 / 300, 50),
    ],
)
def test_physics_mode_sets_up_the_engine(make, settings, time_step_s, iterations):
    import pybullet

    env = make(expert=True, **settings)
    state = env.reset()
    engine = pybullet.getPhysicsEngineParameters(physicsClientId=env.scene.world.client)
    assert engine["fixedTimeStep"] == pytest.approx(time_step_s)
    assert engine["numSolverIterations"] == iterations
    assert play(env, state)["success"]


def test_colours_of_floor_and_workspace_affect_rgb_images_only(make):
    plain = make()
    colored = make(floor_color=(1.0, 1.0, 1.0), workspace_color=(0.1, 0.1, 0.1))
    depth = plain.reset()[keys.DEPTH], colored.reset()[keys.DEPTH]
    assert torch.equal(*depth)
    before, after = plain.render(), colored.render()
    assert before.shape == after.shape
    assert (before != after).any(axis=-1).mean() > 0.2


def test_numpy_values_are_accepted():
    env = ba_torchrl.make(
        PICKING, seed=np.int64(3), object_scale_range=np.array([0.8, 0.9]), dpos=np.float32(0.04)
    )
    assert env.config.seed == 3
    assert env.config.object_scale_range == (0.8, 0.9)
    assert env.config.dpos == pytest.approx(0.04)
    env.close()
