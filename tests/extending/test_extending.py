"""The exercises of docs/architecture.md, "How to add", done outside the package and played.

Each file of ``mine/`` is one addition. None of them edits a file of the package.
"""

from pathlib import Path

import pytest
import torch

import ba_torchrl
from ba_torchrl import testing
from ba_torchrl.data.time_reversal import make_deconstruction_env
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.geometry import downward
from ba_torchrl.training.checkpoint import build_algorithm
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment

HERE = Path(__file__).parent

NEW_TASKS = (
    "mine/bridge",
    "mine/stack_on_plateau",
    "mine/stack_on_random_plateau",
    "mine/stack_of_any_colour",
    "mine/tall_block",
)
MOST_LINES = {
    "behaviour_cloning": 90,
    "bridge": 35,
    "plateau": 60,
    "tall_block": 70,
    "two_views": 90,
    "wrist_camera": 40,
}


def play(env, episodes):
    """Let the expert play; return the number of successes and the steps."""
    successes = steps = 0
    for _ in range(episodes):
        state = env.reset()
        while not state[keys.DONE]:
            state = env.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION].clone()))[keys.NEXT]
            steps += 1
        successes += int(state[keys.SUCCESS])
    return successes, steps


@pytest.mark.parametrize(("name", "most"), MOST_LINES.items())
def test_additions_are_short(name, most):
    assert len((HERE / "mine" / f"{name}.py").read_text().splitlines()) <= most


@pytest.mark.parametrize(("task", "episodes"), [(task, 5) for task in NEW_TASKS])
def test_experts_solve_new_tasks(task, episodes):
    env = ba_torchrl.make(task, seed=0, expert=True, obs_size=32)
    successes, _ = play(env, episodes)
    assert successes == episodes
    env.close()


@pytest.mark.parametrize("task", NEW_TASKS)
def test_new_tasks_keep_the_contract(task):
    testing.check_task(task)


def test_a_structure_has_its_fewest_steps_and_its_deconstruction():
    env = ba_torchrl.make("mine/bridge", seed=0, expert=True)
    assert env.reset() is not None
    assert env.scene.task.structure.blueprint.optimal_steps == 4
    assert play(env, 3) == (3, 12)
    env.close()
    apart = make_deconstruction_env("mine/bridge", seed=0, expert=True)
    assert play(apart, 1)[0] == 1
    apart.close()


def test_a_terrain_raises_what_stands_on_it(additions):
    env = ba_torchrl.make("mine/stack_on_plateau", seed=1, expert=True)
    state = env.reset()
    height_m = additions["plateau"].HEIGHT_M
    bodies = env.scene.task.objects
    assert [body.position[2] for body in bodies] == pytest.approx([height_m + 0.015] * 3, abs=1e-3)
    middle = state[keys.PIXELS][0]
    assert float(middle.min()) == pytest.approx(height_m, abs=1e-6)
    # a pick below the slab is raised until the fingers close above it
    x, y, _ = bodies[0].position
    body = env.scene.controller.pick((x, y, 0.0), downward(0.0))
    assert body is bodies[0]
    env.close()


def test_the_random_parts_of_a_terrain_belong_to_the_episode_and_its_state():
    env = ba_torchrl.make("mine/stack_on_random_plateau", seed=0, obs_size=64)
    heights = []
    for _ in range(3):
        image = env.reset()[keys.PIXELS]
        terrain = env.scene.task.terrain
        heights.append(terrain.height_m((0.0, 0.0)))
        assert float(image.min()) == pytest.approx(heights[-1], abs=1e-6)
    assert len(set(heights)) == 3
    state = env.get_state()
    env.reset()
    env.set_state(state)
    assert terrain.height_m((0.0, 0.0)) == heights[-1]
    env.close()


def test_the_variants_of_a_close_loop_structure_belong_to_its_state():
    env = ba_torchrl.make("mine/stack_of_any_colour", seed=0, obs_size=32)
    env.reset()
    task, state = env.scene.task, env.get_state()
    before = [body.id for body in task.objects]
    drawn = []
    for _ in range(4):
        env.reset()
        drawn.append([body.id for body in task.objects])
    assert any(ids != before for ids in drawn)
    env.set_state(state)
    assert [body.id for body in task.objects] == before
    env.close()


def test_a_close_loop_structure_of_more_pieces_than_have_a_spacing():
    env = ba_torchrl.make("mine/stack_of_any_colour", seed=0, obs_size=32, num_objects=5)
    env.reset()
    assert len(env.scene.task.objects) == 5
    env.close()


def test_a_parameter_of_the_task_alone():
    env = ba_torchrl.make("mine/tall_block", seed=0, tolerance_m=0.5, expert=True)
    env.reset()
    assert env.scene.task.settings.parameters.tolerance_m == 0.5
    assert env.scene.task.evaluate()["is_over_corner"]
    env.close()


def test_a_wrist_camera_is_observed_stored_and_learnt_from(additions, tmp_path):
    env = ba_torchrl.make(
        "close_loop/block_picking", seed=0, obs_size=64, observations=["mine/wrist_camera"]
    )
    image = env.reset()["wrist"]
    assert image.shape == (1, 32, 32)
    assert 0.2 < float(image.max()) <= additions["wrist_camera"].FARTHEST_M
    env.close()
    config = ExperimentConfig.parse(
        {
            "task": "close_loop/block_picking",
            "env": {"obs_size": 64, "max_steps": 10, "observations": ["mine/wrist_camera"]},
            "algorithm": {"name": "sac", "batch_size": 8, "augmentation": "none"},
            "network": {"name": "mine/two_views"},
            "num_envs": 2,
            "parallel": False,
            "demonstrations": 2,
            "min_replay": 1,
            "total_updates": 6,
            "eval_every": 6,
            "eval_episodes": 1,
            "final_eval_episodes": 1,
            "video_episodes": 0,
            "run_dir": str(tmp_path / "run"),
        }
    )
    experiment = Experiment(config, progress=False)
    assert experiment.run().updates == 6
    sample = experiment.algorithm.replay.sample()
    assert sample["wrist"].shape[1:] == sample["next", "wrist"].shape[1:] == (1, 32, 32)
    assert not torch.equal(sample["wrist"], sample["next", "wrist"])


def test_a_network_that_sees_what_is_not_observed_is_refused():
    config = ExperimentConfig.parse(
        {
            "task": "close_loop/block_picking",
            "env": {"obs_size": 64},
            "algorithm": {"name": "sac", "augmentation": "none"},
            "network": {"name": "mine/two_views"},
        }
    )
    with pytest.raises(ConfigError, match="wrist"):
        build_algorithm(config)
