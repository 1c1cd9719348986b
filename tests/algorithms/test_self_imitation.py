"""Collected episodes that succeed as demonstrations."""

from unittest.mock import Mock

import pytest
import torch

from ba_torchrl.core import keys
from tests.algorithms.tiny import build, make_experiment, transitions

SUCCESSES = {"name": "successes"}


def collected(learner, done, success):
    """A step of two environments that begin an episode or are in its second step."""
    data = transitions(learner, 2).exclude(keys.IS_DEMONSTRATION, keys.TARGET_ACTION)
    data[keys.ENV_INDEX] = torch.arange(2)
    data[keys.STEP_COUNT] = torch.tensor([[0], [1]])
    data[keys.FAULT] = torch.zeros(2, 1, dtype=torch.bool)
    data[keys.NEXT, keys.FAULT] = torch.zeros(2, 1, dtype=torch.bool)
    data[keys.NEXT, keys.DONE] = torch.tensor(done)[:, None]
    data[keys.NEXT, keys.SUCCESS] = torch.tensor(success)[:, None]
    return data


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "symmetric"])
def test_transitions_of_successful_episodes_get_the_behaviour_term(replay):
    learner = build("sac", imitation=SUCCESSES, batch_size=4, replay={"name": replay})
    data = collected(learner, [True, False], [True, False])
    learner.on_collected(data)
    assert len(learner.replay) == 1
    batch = learner.sample()
    assert batch[keys.IS_DEMONSTRATION].all()
    assert float(learner.loss(batch)["demonstration_error"]) > 0
    data = collected(learner, [False, True], [False, False])
    learner.on_collected(data)
    assert len(learner.replay) == 3
    assert len(learner.episodes) == 1
    other = build("sac", imitation=SUCCESSES, batch_size=4, replay={"name": replay})
    other.load_replay_state(learner.replay_state())
    assert (len(other.replay), len(other.episodes)) == (3, 1)


def test_successes_are_imitated_where_the_expert_would_act_otherwise():
    learner = build("sac", imitation=SUCCESSES, batch_size=4)
    data = collected(learner, [True, True], [True, False])
    data[keys.EXPERT_ACTION] = -data[keys.ACTION]
    learner.on_collected(data)
    stored = learner.replay.storage[:]
    assert stored[keys.IS_DEMONSTRATION][:, 0].tolist() == [True, False]
    assert torch.equal(stored[keys.TARGET_ACTION], data[keys.ACTION])


@pytest.mark.parametrize("replay", ["uniform", "prioritized", "symmetric"])
def test_successes_fill_at_most_half_of_the_replay(replay):
    learner = build(
        "sac", imitation=SUCCESSES, batch_size=4, replay={"name": replay, "capacity": 6}
    )
    data = collected(learner, [True, True], [True, True])
    for stored in (2, 4, 6, 8):  # of the second two, the half has room for one
        learner.on_collected(data)
        assert learner.replay.num_demonstrations == min(stored, 3)
        assert len(learner.replay) == min(stored, 6)


def test_collected_episodes_are_not_processed_as_those_before_the_first_update():
    learner = build("sac", imitation=SUCCESSES, batch_size=4)
    learner.on_demonstrations = Mock()
    learner.on_collected(collected(learner, [True, True], [True, False]))
    learner.on_demonstrations.assert_not_called()
    assert learner.replay.storage[:][keys.IS_DEMONSTRATION][:, 0].tolist() == [True, False]


def test_without_the_option_transitions_are_stored_at_once():
    learner = build("sac", batch_size=4)
    data = collected(learner, [True, False], [True, False])
    learner.on_collected(data)
    assert len(learner.replay) == 2
    assert learner.replay.num_demonstrations == 0


@pytest.mark.parametrize(
    "collector", ["single", pytest.param("multi_sync", marks=pytest.mark.slow)]
)
def test_a_run_stores_whole_episodes(tmp_path, collector):
    algorithm = {"name": "sac", "imitation": SUCCESSES}
    settings = {"collector": {"name": collector}, "total_updates": 20, "eval_every": 20}
    experiment = make_experiment(tmp_path, "cnn", algorithm, **settings)
    experiment.run()
    learner = experiment.learner
    env_steps = experiment.state.env_steps
    ended = learner.replay.storage.column((keys.NEXT, keys.DONE)).flatten()
    is_demonstration = learner.replay.storage.column(keys.IS_DEMONSTRATION).flatten()
    successful = learner.replay.storage.column((keys.NEXT, keys.REWARD)).flatten() > 0
    demonstrated = len(learner.replay) + len(learner.episodes) - env_steps
    assert demonstrated > 0
    assert is_demonstration[:demonstrated].all()
    assert ended[-1]
    assert ended[demonstrated:].sum() > 2
    # the last transition of an episode determines the flag of all of them
    begin = 0
    for end in ended.nonzero().flatten().tolist():
        assert (is_demonstration[begin : end + 1] == successful[end]).all()
        begin = end + 1
