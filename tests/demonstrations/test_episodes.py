from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import SerialEnv, TransformedEnv

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, SimulationError
from ba_torchrl.data.transitions import as_transitions, chunk_windows
from ba_torchrl.demonstrations.collect import collect_demonstrations
from ba_torchrl.demonstrations.episodes import (
    RESULT_KEYS,
    EpisodeAssembler,
    collect_episodes,
    is_success,
    mean_length,
    quotas,
    success_rate,
)

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


@pytest.mark.parametrize("wrap", [lambda env: env, TransformedEnv], ids=["bare", "transformed"])
def test_vectors_of_torchrl_play_the_same_episodes(expert_env, wrap):
    one = partial(ba_torchrl.make, TASK, expert=True, obs_size=16, seed=0, max_steps=10)
    vector = wrap(SerialEnv(3, one))
    found, expected = (collect_demonstrations(env, 3, seed=5) for env in (vector, expert_env))
    vector.close()
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a["depth"], b["depth"])


def test_an_environment_that_cannot_play_demonstrations_is_refused():
    env = ba_torchrl.make(TASK, obs_size=16, expert=True)
    with pytest.raises(ConfigError, match=r"is no vector; .*make_vector_env\(task, 1"):
        collect_demonstrations(env, 1)
    env = ba_torchrl.make_vector_env(TASK, 1, parallel=False, obs_size=16)
    with pytest.raises(ConfigError, match="make the environment with expert=True"):
        collect_demonstrations(env, 1)
    env.close()


def test_episodes_are_whole_and_repeat_with_the_seed(expert_env):
    first = collect_demonstrations(expert_env, 5, seed=3)
    again = collect_demonstrations(expert_env, 5, seed=3)
    other = collect_demonstrations(expert_env, 5, seed=30)
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a["depth"], b["depth"])
        assert a["step_count"].flatten().tolist() == list(range(len(a)))
        assert a["next", "done"].flatten().tolist() == [False] * (len(a) - 1) + [True]
        assert torch.equal(a["depth"][1:], a["next", "depth"][:-1])
    assert not torch.equal(first[0]["depth"][0], other[0]["depth"][0])


def test_other_episodes_are_played_in_place_of_failed_ones(expert_env):
    played = []
    options = {"only_successful": True, "on_episode": played.append}
    episodes = collect_demonstrations(expert_env, 6, seed=0, noise=0.5, **options)
    assert len(episodes) == 6 < len(played)
    assert success_rate(episodes) == 1.0
    assert success_rate(played) == 6 / len(played)


def test_an_expert_that_hardly_succeeds_is_refused():
    env = ba_torchrl.make_vector_env(
        TASK, 2, parallel=False, expert=True, obs_size=16, seed=0, max_steps=1
    )
    with pytest.raises(ConfigError, match="only 0 of 100 episodes succeed, 3 are needed; take"):
        collect_demonstrations(env, 3, seed=0, only_successful=True)
    env.close()


def test_results_without_observations(expert_env):
    (episode,) = collect_episodes(
        expert_env, lambda td: td.set("action", td["expert_action"]), 1, results_only=True
    )
    assert set(episode.keys()) == {"action", "expert_action", "next"}
    assert set(episode["next"].keys()) == {*RESULT_KEYS}
    assert success_rate([episode]) == 1.0


def test_transitions_are_flat_and_flagged(expert_env):
    (episode,) = collect_demonstrations(expert_env, 1, seed=0)
    out = as_transitions(episode, ["depth"], is_demonstration=True)
    assert out.batch_size == (len(episode),)
    assert out["is_demonstration"].all()
    assert set(out.keys()) == {"depth", "holding", "action", "next", "is_demonstration"}


def test_episodes_with_faults_are_replaced(expert_env, monkeypatch):
    calls = 0
    scene = expert_env._envs[1].scene
    original = scene.controller.move_to

    def fail_once(*args):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise SimulationError("exploded")
        original(*args)

    monkeypatch.setattr(scene.controller, "move_to", fail_once)
    episodes = collect_demonstrations(expert_env, 6)
    assert calls == 2
    assert len(episodes) == 6
    assert not any(episode["next", "fault"].any() for episode in episodes)


# -- from transitions of several environments ---------------------------------------------------


def rows(*transitions):
    """Transitions of (environment, step count, done, success), numbered by their value."""
    envs, counts, done, success = zip(*transitions, strict=True)

    def column(values):
        return torch.tensor(values)[:, None]

    following = {keys.DONE: column(done), keys.SUCCESS: column(success)}
    value = column([10 * env + count for env, count in zip(envs, counts, strict=True)])
    return TensorDict(
        {
            keys.ENV_INDEX: torch.tensor(envs),
            keys.STEP_COUNT: column(counts),
            "value": value,
            keys.NEXT: {**following, "value": value + 1},
        },
        [len(envs)],
    )


def values(episodes):
    """The values of the steps of each episode, and whether it succeeds."""
    return [(each["value"].flatten().tolist(), is_success(each)) for each in episodes]


def test_transitions_are_returned_when_their_episode_ends():
    episodes = EpisodeAssembler()
    assert values(episodes.complete(rows((0, 0, False, False), (1, 0, False, False)))) == []
    found = episodes.complete(rows((0, 1, False, False), (1, 1, True, True)))
    assert values(found) == [([10, 11], True)]
    assert found[0][keys.NEXT, "value"].flatten().tolist() == [11, 12]
    assert len(episodes) == 2
    found = episodes.complete(rows((0, 2, True, False), (1, 0, True, True)))
    assert values(found) == [([0, 1, 2], False), ([10], True)]
    assert len(episodes) == 0


def test_an_episode_that_is_cut_off_by_another_one_is_unsuccessful():
    episodes = EpisodeAssembler()
    episodes.complete(rows((3, 0, False, False)))
    episodes.complete(rows((3, 1, False, False)))
    found = episodes.complete(rows((3, 0, True, True)))
    assert values(found) == [([30, 31], False), ([30], True)]


def test_an_episode_whose_next_step_is_missing_is_unsuccessful():
    episodes = EpisodeAssembler()
    episodes.complete(rows((0, 0, False, False), (0, 1, False, False)))
    found = episodes.complete(rows((0, 5, False, False), (0, 6, True, True)))
    assert values(found) == [([0, 1], False), ([5, 6], True)]


def test_a_batch_can_hold_several_steps_of_an_environment():
    episodes = EpisodeAssembler()
    found = episodes.complete(
        rows((0, 0, False, False), (0, 1, True, True), (0, 0, False, False), (1, 0, True, False))
    )
    assert values(found) == [([0, 1], True), ([10], False)]
    assert len(episodes) == 1


def test_a_restored_state_continues_the_episodes():
    first, second = EpisodeAssembler(), EpisodeAssembler()
    first.complete(rows((0, 0, False, False), (2, 0, False, False)))
    second.load_state_dict(first.state_dict())
    assert len(second) == 2
    data = rows((2, 1, True, True), (0, 1, False, False))
    for assembler in (first, second):
        assert values(assembler.complete(data)) == [([20, 21], True)]
    (one,), (other,) = (each.complete(rows((0, 2, True, False))) for each in (first, second))
    assert (one == other).all()


def test_a_chunk_ends_with_its_episode_and_where_the_expert_did_not_act():
    actions, known = torch.arange(5.0)[:, None], torch.tensor([1, 1, 1, 0, 1]).bool()
    chunks, is_valid = chunk_windows(actions, known, known, 3)
    rows = [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 4], [4, 4, 4]]
    assert chunks.squeeze(-1).tolist() == rows
    assert is_valid.int().tolist() == [[1, 1, 1], [1, 1, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]]
    # known everywhere, and a random action in its place at the second step
    _, is_valid = chunk_windows(actions, known | True, torch.tensor([1, 0, 1, 1, 1]).bool(), 3)
    assert is_valid.int().tolist() == [[1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 0], [1, 0, 0]]
