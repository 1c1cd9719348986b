import pytest
import torch

import ba_torchrl
from ba_torchrl.data.demo_files import load_demonstrations, save_demonstrations
from ba_torchrl.data.demos import collect_demonstrations
from ba_torchrl.data.episodes import (
    RESULT_KEYS,
    collect_episodes,
    mean_length,
    quotas,
    success_rate,
)
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.errors import ConfigError

TASK = "close_loop/block_reaching"


@pytest.fixture(scope="module")
def expert_env():
    env = ba_torchrl.make_vector_env(
        TASK, 3, parallel=False, expert=True, obs_size=16, seed=0, max_steps=10
    )
    yield env
    env.close()


def test_quotas_differ_by_at_most_one():
    assert quotas(10, 4) == [3, 3, 2, 2]
    assert quotas(2, 5) == [1, 1, 0, 0, 0]


def test_each_environment_plays_its_quota_and_short_episodes_are_not_favoured(expert_env):
    # the third environment never finishes before the step limit, the others do at once
    def policy(state):
        action = state["expert_action"].clone()
        action[2] = 0
        return state.set("action", action)

    episodes = collect_episodes(expert_env, policy, 8, seed=0)
    lengths = [len(episode) for episode in episodes]
    assert len(episodes) == 8
    assert all(length < 10 for length in lengths[:6])
    assert lengths[6:] == [10, 10]
    assert success_rate(episodes) == 6 / 8
    assert mean_length(episodes) == sum(lengths) / 8


def test_episodes_are_whole_and_repeat_with_the_seed(expert_env):
    first = collect_demonstrations(expert_env, 5, seed=3)
    again = collect_demonstrations(expert_env, 5, seed=3)
    other = collect_demonstrations(expert_env, 5, seed=30)
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a["pixels"], b["pixels"])
        assert a["step_count"].flatten().tolist() == list(range(len(a)))
        assert a["next", "done"].flatten().tolist() == [False] * (len(a) - 1) + [True]
        assert torch.equal(a["pixels"][1:], a["next", "pixels"][:-1])
    assert not torch.equal(first[0]["pixels"][0], other[0]["pixels"][0])


def test_results_without_observations(expert_env):
    (episode,) = collect_episodes(
        expert_env, lambda td: td.set("action", td["expert_action"]), 1, results_only=True
    )
    assert set(episode.keys()) == {"action", "expert_action", "next"}
    assert set(episode["next"].keys()) == {*RESULT_KEYS}
    assert success_rate([episode]) == 1.0


def test_transitions_are_flat_and_flagged(expert_env):
    (episode,) = collect_demonstrations(expert_env, 1, seed=0)
    out = as_transitions(episode, ["pixels"], is_demonstration=True)
    assert out.batch_size == (len(episode),)
    assert out["is_demonstration"].all()
    assert set(out.keys()) == {"pixels", "holding", "action", "next", "is_demonstration"}


def test_demonstrations_are_restored_from_disk(expert_env, tmp_path):
    episodes = collect_demonstrations(expert_env, 4, seed=0)
    env = {"obs_size": 16, "max_steps": 10}
    save_demonstrations(tmp_path / "demos", episodes, task=TASK, env=env, seed=0)
    loaded = load_demonstrations(tmp_path / "demos", task=TASK, env=env)
    assert [len(e) for e in loaded] == [len(e) for e in episodes]
    for a, b in zip(episodes, loaded, strict=True):
        assert torch.equal(a["next", "pixels"], b["next", "pixels"])
        assert torch.equal(a["action"], b["action"])


def test_demonstrations_of_other_environments_are_refused(expert_env, tmp_path):
    episodes = collect_demonstrations(expert_env, 1, seed=0)
    save_demonstrations(tmp_path / "demos", episodes, task=TASK, env={"obs_size": 16}, seed=0)
    with pytest.raises(ConfigError, match="obs_size: collected with 16, needed 64") as error:
        load_demonstrations(
            tmp_path / "demos", task="close_loop/block_picking", env={"obs_size": 64}
        )
    assert "task: collected with 'close_loop/block_reaching'" in str(error.value)
    with pytest.raises(ConfigError, match="no demonstrations"):
        load_demonstrations(tmp_path / "nowhere", task=TASK, env={})


def test_episodes_with_faults_are_replaced(expert_env, monkeypatch):
    calls = 0
    scene = expert_env._envs[1].scene
    original = scene.controller.move_to

    def fail_once(*args):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise RuntimeError("exploded")
        original(*args)

    monkeypatch.setattr(scene.controller, "move_to", fail_once)
    episodes = collect_demonstrations(expert_env, 6)
    assert calls == 2
    assert len(episodes) == 6
    assert not any(episode["next", "fault"].any() for episode in episodes)
