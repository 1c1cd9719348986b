"""What a task tells of itself."""

import pytest

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs import description
from ba_torchrl.tasks.base import TASKS, versions_of


def test_a_description_holds_what_the_environment_has(make):
    found = ba_torchrl.describe("open_loop/bin_packing")
    env = make("open_loop/bin_packing", seed=0)
    env.reset()
    try:
        assert found.conditions == tuple(env.conditions)
        assert found.observations["heightmap"] == tuple(env.observation_spec["heightmap"].shape)
        assert list(found.actions) == list(env.actions.components)
        assert found.actions["x"] == pytest.approx(env.config.workspace[0])
        assert found.max_steps == env.max_steps
    finally:
        env.close()
    assert found.versions == versions_of("open_loop/bin_packing")
    assert f"version:            {found.versions.task}, expert {found.versions.expert}" in str(
        found
    )
    assert found.numbers_of_objects == tuple(range(1, 11))
    assert "a bin" in found.text
    panda = description.expert_scores()["open_loop/bin_packing"]["panda"]
    assert "expert:             kuka 1.000 in 16.0 steps (200 episodes), panda " in str(found)
    assert f"panda {panda.success_rate:.3f} ({panda.episodes} episodes), ur5" in str(found)


def test_every_task_of_the_package_has_a_goal_and_an_experts_score():
    scores = description.expert_scores()
    own = [task for task in TASKS if TASKS.plugin_module(task) is None]
    assert set(scores) == set(own)
    for task in own:
        assert set(scores[task]) <= set(ba_torchrl.list_robots())
        assert all(0.9 < score.success_rate <= 1 for score in scores[task].values())
        assert len(description.summary(task)) > 15


def test_an_unknown_task_is_named():
    with pytest.raises(ConfigError, match="Did you mean 'close_loop/block_picking'"):
        ba_torchrl.describe("close_loop/block_pickin")


def test_the_text_of_an_environment_names_task_robot_image_and_action(make):
    env = make("close_loop/block_reaching", robot="panda", obs_size=32)
    text = repr(env)
    assert text == (
        "CloseLoopEnv(close_loop/block_reaching, panda, depth 1 x 32 x 32, action pxyzr)"
    )
    env = make("close_loop/block_reaching", obs_type="vec")
    assert "kuka, vec, action" in repr(env)
    assert ba_torchrl.list_robots() == ["kuka", "panda", "ur5", "ur5_robotiq"]
