"""DAgger: labels are the expert's, actions are the policy's or the expert's."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.core import keys
from ba_torchrl.tasks.open_loop.block_stacking import BlockStacking
from tests.algorithms.tiny import OPEN, build, run, transitions


def visited(learner):
    """Transitions of the policy, with the expert's actions."""
    data = transitions(learner)
    data[keys.NEXT, keys.FAULT] = torch.zeros(len(data), 1, dtype=torch.bool)
    return data.set(keys.EXPERT_ACTION, -data[keys.ACTION] / 2)


def test_the_label_is_the_action_of_the_expert():
    learner = build("dagger")
    data = visited(learner)
    stored = learner.to_transitions(data, is_demonstration=False)
    assert torch.equal(stored[keys.TARGET_ACTION], data[keys.EXPERT_ACTION])
    del data[keys.EXPERT_ACTION]
    with pytest.raises(KeyError, match="expert_action"):
        learner.to_transitions(data, is_demonstration=False)
    stored = learner.to_transitions(data, is_demonstration=True)  # demonstrations without noise
    assert torch.equal(stored[keys.TARGET_ACTION], data[keys.ACTION])


def test_the_expert_acts_with_probability_beta():
    learner = build("dagger", beta_init=0.3)
    data = torch.cat([visited(learner)] * 20)
    with set_exploration_type(ExplorationType.RANDOM):
        acted = learner.policy(data.clone())[keys.ACTION]
    is_expert = (acted == data[keys.EXPERT_ACTION]).all(dim=1)
    assert 0.2 < float(is_expert.float().mean()) < 0.4
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(data.exclude(keys.EXPERT_ACTION))[keys.ACTION]
    assert not (greedy == data[keys.EXPERT_ACTION]).all(dim=1).any()


def test_beta_decreases_linearly_to_zero():
    learner = build("dagger", beta_init=0.6, beta_updates=3, batch_size=4)
    learner.extend(learner.to_transitions(visited(learner), is_demonstration=True))
    betas = []
    for _ in range(5):
        betas.append(learner.policy.beta.item())
        learner.update()
    assert betas == pytest.approx([0.6, 0.4, 0.2, 0.0, 0.0])
    torch.rand(3, generator=learner.policy.generator)
    other = build("dagger", beta_init=0.6, beta_updates=6, batch_size=4)
    other.load_state_dict(learner.state_dict())
    assert other.policy.beta.item() == pytest.approx(0.1)
    states = [each.policy.generator.get_state() for each in (learner, other)]
    assert torch.equal(*states)


def test_two_iterations_of_a_run_in_the_open_loop(tmp_path):
    settings = {"name": "dagger", "beta_init": 0.5}
    learner = run(tmp_path, "asr", settings, **OPEN)
    assert (~learner.replay.storage.column(keys.IS_DEMONSTRATION)).sum() == 4
    labels = learner.replay.storage.column(keys.TARGET_ACTION)
    is_expert = learner.replay.storage.column(keys.IS_DEMONSTRATION)[:, 0]
    nearest = learner.nearest_action(labels)
    torch.testing.assert_close(nearest[is_expert], labels[is_expert])
    assert not torch.allclose(nearest[~is_expert], labels[~is_expert], atol=1e-5)


def test_the_executed_action_of_an_expert_is_on_the_grid(tmp_path):
    learner = run(tmp_path, "asr", {"name": "dagger", "beta_init": 1.0}, **OPEN)
    learner.policy.beta.fill_(1.0)
    state = learner.replay.storage[:].select(*learner.observation_keys, keys.ACTION)
    state.rename_key_(keys.ACTION, keys.EXPERT_ACTION)
    with set_exploration_type(ExplorationType.RANDOM):
        acted = learner.policy(state)[keys.ACTION]
    assert torch.equal(acted, learner.nearest_action(state[keys.EXPERT_ACTION]))


def test_equal_moves_are_imitated_in_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(BlockStacking, "equal_moves", 3)
    monkeypatch.setattr(BlockStacking, "expert_moves", two_moves)
    learner = run(tmp_path, "asr", {"name": "dagger", "rotation": {"name": "d4"}}, **OPEN)
    column = learner.replay.storage.column
    labels, moves = column(keys.TARGET_ACTION), column(keys.TARGET_MOVES)
    assert moves.shape == (len(labels), 3, 4)
    assert torch.equal(moves[:, 0], labels)
    assert torch.equal(moves[:, 2], labels)  # the first again
    assert (moves[:, 1] != labels).any(dim=1).all()
    assert {True, False} == set(column(keys.IS_DEMONSTRATION).flatten().tolist())
    batch = learner.sample()
    found = learner.loss(batch)["accuracy"]
    assert 0 <= float(found) <= 1
    plain = run(tmp_path / "plain", "asr", {"name": "dagger", "equal_moves": False}, **OPEN)
    assert keys.TARGET_MOVES not in plain.replay.storage[:].keys()  # noqa: SIM118


def two_moves(task):
    first = task.expert_command()
    return [first, first._replace(x_m=0.45 - (first.x_m - 0.45))]
