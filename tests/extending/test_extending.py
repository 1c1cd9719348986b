"""What docs/plugins.md describes, done outside the package and played.

Each file of ``mine/`` is one addition. None of them edits a file of the package. docs/plugins.md
shows some of them.
"""

import itertools
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import torch

import ba_torchrl
from ba_torchrl import testing
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.collect import expert_scores
from ba_torchrl.demonstrations.time_reversal import make_deconstruction_env
from ba_torchrl.sim.geometry import downward
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.close_loop.block_reaching import BlockReaching
from ba_torchrl.testing.episodes import play_expert
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment
from ba_torchrl.training.learner import build_learner
from tests.tasks.episodes import slow

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"
NEW_TASKS = (
    "mine/bridge",
    *slow(["mine/stack_on_plateau", "mine/stack_on_random_plateau", "mine/stack_of_any_colour"]),
)


@pytest.fixture
def started():
    """Return a function that makes an environment and starts an episode."""
    with ExitStack() as envs:
        yield lambda task, **config: _start(envs, task, **{"seed": 0, "obs_size": 32, **config})


def _start(envs, task, **config):
    env = envs.enter_context(closing(ba_torchrl.make(task, **config)))
    return env, env.reset()


@pytest.mark.parametrize("task", NEW_TASKS)
def test_new_tasks_keep_the_contract_and_experts_solve_them(task):
    steps = 4 if task == "mine/bridge" else None
    report = testing.check_task(task, episodes=5, min_success_rate=1.0, max_typical_steps=steps)
    assert report.success_rate == 1.0
    assert report.warning is None
    assert report.label_jumps <= 0.1
    has_noise = TASKS[task].control == "close_loop"
    assert (report.noisy_success_rate is not None) is has_noise
    assert ("with the noise of a learned policy" in str(report)) is has_noise


def test_a_task_whose_episodes_are_equal_fails_the_contract(monkeypatch):
    def initialize_episode(task, rng):
        task.stand(task.block, task.settings.workspace.center, 0.0)

    monkeypatch.setattr(BlockReaching, "initialize_episode", initialize_episode)
    with pytest.raises(AssertionError, match="block_reaching: the seed changes nothing"):
        testing.check_task("close_loop/block_reaching")


def test_an_expert_that_is_hard_to_imitate_passes_with_warnings(monkeypatch):
    monkeypatch.setattr("ba_torchrl.testing.tasks.CHECKS", ())
    monkeypatch.setattr("ba_torchrl.testing.labels.JUMP_MM", 1e-6)  # as if all labels jumped
    monkeypatch.setattr(BlockReaching, "goal_distance_m", 0.003)
    with pytest.warns(UserWarning, match=r"solves 1\.00 .* and 0\.[0-6]0 with the noise"):
        report = testing.check_task("close_loop/block_reaching", episodes=5)
    assert "in 1.00 of the states, the expert's action jumps" in report.warning
    assert str(report).endswith(f"warning: {report.warning}")


@pytest.mark.parametrize(
    ("method", "error"),
    [
        ("expert_command", TypeError("no command")),
        ("evaluate", IndexError("no such block")),
        ("instruction", KeyError("colour")),
    ],
)
def test_an_error_of_a_task_fails_its_check_as_it_is(monkeypatch, method, error):
    correct, calls = getattr(BlockReaching, method), itertools.count()

    def wrong_later(task):
        if next(calls) == 3:
            raise error
        return correct(task)

    monkeypatch.setattr(BlockReaching, method, wrong_later)
    with pytest.raises(type(error)) as raised:
        testing.check_task("close_loop/block_reaching")
    assert raised.value is error


def test_a_structure_has_its_deconstruction():
    with closing(make_deconstruction_env("mine/bridge", seed=0, expert=True)) as apart:
        (episode,) = play_expert(apart, 1)
    assert episode["next", "success"][-1]


def test_a_terrain_raises_what_stands_on_it(additions, started):
    env, state = started("mine/stack_on_plateau", seed=1, obs_size=128)
    height_m = additions["plateau"].HEIGHT_M
    bodies = env.scene.task.objects
    assert [body.position[2] for body in bodies] == pytest.approx([height_m + 0.015] * 3, abs=1e-3)
    assert float(state[keys.HEIGHTMAP].min()) == pytest.approx(height_m, abs=1e-6)
    # a pick below the slab is raised until the fingers close above it
    x, y, _ = bodies[0].position
    body = env.scene.controller.pick((x, y, 0.0), downward(0.0))
    assert body is bodies[0]


def test_the_random_parts_of_a_terrain_belong_to_the_episode_and_its_state(started):
    env, state = started("mine/stack_on_random_plateau", obs_size=64)
    terrain, heights = env.scene.task.terrain, []
    for _ in range(3):
        heights.append(terrain.height_m((0.0, 0.0)))
        assert float(state[keys.HEIGHTMAP].min()) == pytest.approx(heights[-1], abs=1e-6)
        kept, state = env.get_state(), env.reset()
    assert len(set(heights)) == 3
    env.reset(kept, set_state=True)
    assert terrain.height_m((0.0, 0.0)) == heights[-1]


def test_the_variants_of_a_close_loop_structure_belong_to_its_state(started):
    env, _ = started("mine/stack_of_any_colour")
    task, state = env.scene.task, env.get_state()
    before = [body.id for body in task.objects]
    drawn = []
    for _ in range(4):
        env.reset()
        drawn.append([body.id for body in task.objects])
    assert any(ids != before for ids in drawn)
    env.reset(state, set_state=True)
    assert [body.id for body in task.objects] == before


def test_a_close_loop_structure_of_more_pieces_than_have_a_spacing(started):
    env, _ = started("mine/stack_of_any_colour", num_objects=5)
    assert len(env.scene.task.objects) == 5


def test_a_parameter_of_the_task_alone(started):
    env, _ = started("mine/my_task", tolerance_m=0.5)
    assert env.scene.task.settings.parameters.tolerance_m == 0.5
    assert env.scene.task.evaluate()["is_over_plate"]
    assert env.instruction == "hold the red block over the blue plate"


def test_an_expert_grasps_with_longer_fingers():
    scores = expert_scores(
        "close_loop/block_picking", 5, seed=0, num_envs=1, parallel=False, robot="mine/long_jaw"
    )
    assert scores.success_rate == 1


@pytest.mark.parametrize("name", ["plateau", "long_jaw"])
def test_the_page_of_plugins_shows_the_file(name):
    code = (Path(__file__).parent / "mine" / f"{name}.py").read_text()
    assert f"```python\n{code}```" in PAGE.read_text()


def two_views(env=(), **other):
    """Return the configuration of a run whose network sees a wrist camera, too."""
    return ExperimentConfig.parse(
        {
            "task": "close_loop/block_picking",
            "env": {"obs_size": 64, "max_steps": 10, **dict(env)},
            "algorithm": {"name": "sac", "batch_size": 8},
            "network": {"name": "mine/two_views"},
            **other,
        }
    )


def test_a_wrist_camera_is_observed_stored_and_learnt_from(additions, started, tmp_path):
    observations = {"observations": ["mine/wrist_camera"]}
    _, state = started("close_loop/block_picking", obs_size=64, **observations)
    assert state["wrist"].shape == (1, 32, 32)
    assert 0.2 < float(state["wrist"].max()) <= additions["wrist_camera"].FARTHEST_M
    config = two_views(
        observations,
        num_envs=2,
        parallel=False,
        demonstrations=2,
        min_replay=1,
        total_updates=6,
        eval_every=6,
        eval_episodes=1,
        final_eval_episodes=1,
        video_episodes=0,
        run_dir=str(tmp_path / "run"),
    )
    experiment = Experiment(config, progress=False)
    assert experiment.run().updates == 6
    sample = experiment.learner.replay.sample()
    assert sample["wrist"].shape[1:] == sample["next", "wrist"].shape[1:] == (1, 32, 32)
    assert not torch.equal(sample["wrist"], sample["next", "wrist"])


def test_a_network_that_sees_what_is_not_observed_is_refused():
    with pytest.raises(ConfigError, match="wrist"):
        build_learner(two_views())
