"""Transitions of several environments as episodes with a flag of success."""

import torch
from tensordict import TensorDict

from ba_torchrl.data.episode_assembler import EpisodeAssembler
from ba_torchrl.envs import keys


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


def values(data):
    return data["value"].flatten().tolist(), data[keys.IS_EXPERT].flatten().tolist()


def test_transitions_are_returned_when_their_episode_ends():
    episodes = EpisodeAssembler()
    assert values(episodes.complete(rows((0, 0, False, False), (1, 0, False, False)))) == ([], [])
    found = episodes.complete(rows((0, 1, False, False), (1, 1, True, True)))
    assert values(found) == ([10, 11], [True, True])
    assert torch.equal(found[keys.NEXT, "value"], found["value"] + 1)
    assert len(episodes) == 2
    found = episodes.complete(rows((0, 2, True, False), (1, 0, True, True)))
    assert values(found) == ([0, 1, 2, 10], [False] * 3 + [True])
    assert len(episodes) == 0


def test_an_episode_that_is_cut_off_by_another_one_is_unsuccessful():
    episodes = EpisodeAssembler()
    episodes.complete(rows((3, 0, False, False)))
    episodes.complete(rows((3, 1, False, False)))
    found = episodes.complete(rows((3, 0, True, True)))
    assert values(found) == ([30, 31, 30], [False, False, True])


def test_an_episode_whose_next_step_is_missing_is_unsuccessful():
    episodes = EpisodeAssembler()
    episodes.complete(rows((0, 0, False, False), (0, 1, False, False)))
    found = episodes.complete(rows((0, 5, False, False), (0, 6, True, True)))
    assert values(found) == ([0, 1, 5, 6], [False, False, True, True])


def test_a_batch_can_hold_several_steps_of_an_environment():
    episodes = EpisodeAssembler()
    found = episodes.complete(
        rows((0, 0, False, False), (0, 1, True, True), (0, 0, False, False), (1, 0, True, False))
    )
    assert values(found) == ([0, 1, 10], [True, True, False])
    assert len(episodes) == 1


def test_a_restored_state_continues_the_episodes():
    first, second = EpisodeAssembler(), EpisodeAssembler()
    first.complete(rows((0, 0, False, False), (2, 0, False, False)))
    second.load_state_dict(first.state_dict())
    assert len(second) == 2
    data = rows((2, 1, True, True), (0, 1, False, False))
    for assembler in (first, second):
        assert values(assembler.complete(data)) == ([20, 21], [True, True])
    assert (
        first.complete(rows((0, 2, True, False))) == second.complete(rows((0, 2, True, False)))
    ).all()
