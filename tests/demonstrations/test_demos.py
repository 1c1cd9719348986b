import json

import pytest
import torch

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import read_state, write_checksums, write_state
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.demonstrations import demo_files
from ba_torchrl.demonstrations.collect import (
    collect_demonstrations,
    source_config,
)
from ba_torchrl.demonstrations.demo_files import load_demonstrations, save_demonstrations
from ba_torchrl.tasks.base import TASKS
from tests.tasks.episodes import demonstrations

TASK = "open_loop/block_stacking"
ENV = {"obs_size": 32, "num_objects": 2}


@pytest.fixture(scope="module", params=["expert", "deconstruction"])
def collected(request):
    env = ba_torchrl.make_vector_env(
        TASK, 2, parallel=False, seed=0, **ENV, **source_config(request.param)
    )
    yield request.param, collect_demonstrations(env, 4, seed=0, source=request.param)
    env.close()


def test_both_sources_give_episodes_of_the_same_form(collected):
    plain = ba_torchrl.make(TASK, seed=0, **ENV)
    rollout = plain.rollout(2)
    plain.close()
    _, episodes = collected
    for episode in episodes:
        assert set(episode.keys(True, True)) == set(rollout.keys(True, True))
        assert len(episode) == 2
        assert episode["next", "success"].flatten().tolist() == [False, True]
        assert episode["holding"].flatten().tolist() == [False, True]


def test_the_primitive_follows_what_is_held(collected):
    for episode in collected[1]:
        assert episode["action"][:, 0].tolist() == [0, 1]


def test_demonstrations_of_both_sources_can_be_loaded(collected, tmp_path):
    source, episodes = collected
    path = tmp_path / "demos"
    save_demonstrations(path, episodes, task=TASK, env=ENV, seed=0, source=source)
    assert len(load_demonstrations(path)) == len(episodes)  # of any task
    loaded = load_demonstrations(path, task=TASK, env=ENV)
    for episode, original in zip(loaded, episodes, strict=True):
        for key in original.keys(True, True):
            assert torch.equal(episode[key], original[key]), key
    assert "episode" not in episodes[0]
    metadata = json.loads((path / "demonstrations.json").read_text())
    assert metadata["source"] == source
    assert metadata["seed"] == 0
    assert set(metadata["versions"]) == {"ba_torchrl", "torch", "torchrl"}


def test_explicit_default_values_are_accepted(collected, tmp_path, monkeypatch):
    _, episodes = collected
    monkeypatch.setenv("HOME", str(tmp_path))
    save_demonstrations("~/demos", episodes, task=TASK, env=ENV, seed=0)
    spelled = {"action_sequence": "pxyr", "half_rotation": True, "max_steps": 10, "robot": "kuka"}
    loaded = load_demonstrations(tmp_path / "demos", task=TASK, env={**ENV, **spelled})
    assert len(loaded) == len(episodes)
    with pytest.raises(ConfigError, match="half_rotation: collected with True, needed False"):
        load_demonstrations(tmp_path / "demos", task=TASK, env={**ENV, "half_rotation": False})


def test_another_configuration_is_refused_by_name(collected, tmp_path):
    _, episodes = collected
    save_demonstrations(tmp_path / "demos", episodes, task=TASK, env=ENV, seed=0)
    with pytest.raises(ConfigError, match="in_hand_mode: collected with 'raw', needed 'proj'"):
        load_demonstrations(tmp_path / "demos", task=TASK, env={**ENV, "in_hand_mode": "proj"})
    with pytest.raises(ConfigError, match="num_objects: collected with 2, needed 3"):
        load_demonstrations(tmp_path / "demos", task=TASK, env={**ENV, "num_objects": 3})
    with pytest.raises(ConfigError, match="task: collected with 'open_loop/block_stacking'"):
        load_demonstrations(tmp_path / "demos", task="close_loop/block_picking", env={})
    with pytest.raises(ConfigError, match="no demonstrations"):
        load_demonstrations(tmp_path / "nowhere", task=TASK, env=ENV)


def test_a_field_that_was_added_later_has_its_default(collected, tmp_path):
    _, episodes = collected
    save_demonstrations(tmp_path, episodes, task=TASK, env=ENV, seed=0)
    file = tmp_path / "demonstrations.json"
    metadata = json.loads(file.read_text())
    assert metadata["env"].pop("object_type") == "cube"
    file.write_text(json.dumps(metadata))
    write_checksums(tmp_path)
    assert len(load_demonstrations(tmp_path, task=TASK, env=ENV)) == len(episodes)
    with pytest.raises(ConfigError, match="object_type: collected with 'cube', needed 'cylinder'"):
        load_demonstrations(tmp_path, task=TASK, env={**ENV, "object_type": "cylinder"})
    for name, message in (
        ("task", "does not say what was collected"),
        ("format", "has not the format 3 of this version; collect"),
    ):
        del metadata[name]
        file.write_text(json.dumps(metadata))
        write_checksums(tmp_path)
        with pytest.raises(ConfigError, match=message):
            load_demonstrations(tmp_path, task=TASK, env=ENV)


def test_other_versions_of_task_and_expert_are_refused_and_said(
    collected, tmp_path, monkeypatch, caplog
):
    _, episodes = collected
    save_demonstrations(tmp_path / "a", episodes, task=TASK, env=ENV, seed=0)
    save_demonstrations(tmp_path / "b", episodes, task=TASK, env=ENV, seed=0, source="keyboard")
    monkeypatch.setattr(TASKS[TASK], "expert_version", 2)
    for name in ("a", "a", "b"):
        load_demonstrations(tmp_path / name, task=TASK, env=ENV)
    assert [record.message for record in caplog.records] == [
        f"the demonstrations at {tmp_path / 'a'} are of version 0 of the expert of {TASK}, which "
        "has version 2 here"
    ]
    monkeypatch.setattr(TASKS[TASK], "version", 1)
    with pytest.raises(ConfigError, match="task_version: collected with 0, needed 1"):
        load_demonstrations(tmp_path / "a", task=TASK, env=ENV)
    with pytest.raises(ConfigError, match=r"are of version 0 of .*; collect them again"):
        demo_files.read_demonstrations(tmp_path / "a")
    load_demonstrations(tmp_path / "a")
    assert caplog.messages[-1].endswith(f"are of version 0 of {TASK}, which has version 1 here")


@pytest.mark.parametrize(
    "changed", [{"holding": torch.ones(3, 1)}, {"holding": 1}, {"episode_lengths": torch.ones(0)}]
)
def test_folders_with_other_tensors_are_refused(collected, tmp_path, changed):
    _, episodes = collected
    save_demonstrations(tmp_path / "demos", episodes, task=TASK, env=ENV, seed=0)
    write_state(tmp_path / "demos", {**read_state(tmp_path / "demos"), **changed})
    write_checksums(tmp_path / "demos")
    with pytest.raises(ConfigError, match="does not hold episodes"):
        load_demonstrations(tmp_path / "demos", task=TASK, env=ENV)


def test_demonstrations_are_not_overwritten(collected, tmp_path):
    _, episodes = collected
    save_demonstrations(tmp_path, episodes, task=TASK, env=ENV, seed=0)
    with pytest.raises(FileExistsError, match="choose another folder"):
        save_demonstrations(tmp_path, episodes, task=TASK, env=ENV, seed=1)


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("close_loop/block_reaching", {}, "episode 0 has no depth, as"),
        (TASK, {"observations": ["proprio"]}, "episode 0 has no proprio"),
        (TASK, {"in_hand_mode": "proj"}, r"in_hand has the shape \[1, .*, needed \[3, "),
        (TASK, {"action_sequence": "pxy", "random_orientation": False}, "action has the shape"),
    ],
)
def test_episodes_of_another_environment_are_not_saved(collected, tmp_path, task, changes, message):
    env = {**ENV, **changes} if task == TASK else changes
    with pytest.raises(ConfigError, match=message):
        save_demonstrations(tmp_path / "demos", collected[1], task=task, env=env, seed=0)


def test_a_folder_that_is_not_complete_is_removed(collected, tmp_path, monkeypatch):
    monkeypatch.setattr(demo_files, "write_checksums", lambda folder: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        save_demonstrations(tmp_path / "demos", collected[1], task=TASK, env=ENV, seed=0)
    assert list(tmp_path.iterdir()) == []


NOISY_TASK = "close_loop/block_reaching"
NOISY = {"num_envs": 2, "env": {"obs_size": 32}}


@pytest.fixture(scope="module")
def noisy():
    """Episodes with random actions: what was returned, and the steps with the expert's actions."""
    played = []
    episodes = demonstrations(NOISY_TASK, 30, **NOISY, noise=0.3, on_episode=played.append)
    return episodes, played, demonstrations(NOISY_TASK, 30, **NOISY, noise=0.3)


def test_random_actions_of_a_demonstration_are_flagged(noisy):
    episodes, played, _ = noisy
    steps = torch.cat(episodes)
    labels = [episode[keys.EXPERT_ACTION] for episode in played]
    for episode in episodes:
        assert any(torch.equal(episode[keys.EXPERT_ACTION], label) for label in labels)
    assert keys.EXPERT_ACTION not in steps[keys.NEXT]
    is_expert = steps[keys.IS_EXPERT].squeeze(-1)
    same = (steps[keys.ACTION] == steps[keys.EXPERT_ACTION]).all(dim=-1)
    assert torch.equal(same, is_expert)
    assert is_expert.float().mean() == pytest.approx(0.7, abs=0.1)
    drawn = steps[keys.ACTION][~is_expert]
    assert drawn.min() < -0.8
    assert drawn.max() > 0.8
    assert drawn.abs().max() <= 1


def test_the_expert_recovers_from_random_actions(noisy):
    episodes, _, _ = noisy
    assert all(episode[keys.NEXT, keys.SUCCESS][-1] for episode in episodes)


def test_random_actions_are_those_of_the_seed(noisy):
    episodes, _, again = noisy
    for one, other in zip(episodes, again, strict=True):
        assert torch.equal(one[keys.ACTION], other[keys.ACTION])


def test_flags_are_those_of_the_transitions_and_of_a_file(noisy, tmp_path):
    episodes, _, _ = noisy
    env = {"obs_size": 32}
    save_demonstrations(tmp_path / "demos", episodes, task=NOISY_TASK, env=env, seed=0)
    loaded = load_demonstrations(tmp_path / "demos", task=NOISY_TASK, env=env)
    for episode, other in zip(episodes, loaded, strict=True):
        for each in (episode, other):
            stored = as_transitions(each, [keys.DEPTH], is_demonstration=True)
            assert torch.equal(stored[keys.IS_DEMONSTRATION], episode[keys.IS_EXPERT])
            assert keys.TARGET_ACTION not in stored
            labelled = as_transitions(
                each, [keys.DEPTH], is_demonstration=True, imitates="expert_everywhere"
            )
            assert labelled[keys.IS_DEMONSTRATION].all()
            assert torch.equal(labelled[keys.TARGET_ACTION], episode[keys.EXPERT_ACTION])
            assert torch.equal(labelled[keys.ACTION], episode[keys.ACTION])


def test_without_labels_only_the_steps_of_the_expert_are_imitated(noisy):
    episode = noisy[0][0].exclude(keys.EXPERT_ACTION)
    stored = as_transitions(episode, [keys.DEPTH], is_demonstration=True, imitates="expert")
    assert torch.equal(stored[keys.IS_DEMONSTRATION], episode[keys.IS_EXPERT])
    assert torch.equal(stored[keys.TARGET_ACTION], episode[keys.ACTION])
    with pytest.raises(KeyError, match="expert_action"):
        as_transitions(episode, [keys.DEPTH], is_demonstration=False, imitates="expert_everywhere")


def test_labels_of_demonstrations_are_actions_that_the_policy_can_choose():
    options = {**NOISY, "noise": 0.3, "nearest_action": torch.round}
    episodes = demonstrations(NOISY_TASK, 2, **options)
    steps = torch.cat(episodes)
    for key in (keys.ACTION, keys.EXPERT_ACTION):
        assert torch.equal(steps[key], steps[key].round())
    assert not torch.equal(steps[keys.ACTION], steps[keys.EXPERT_ACTION])


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_random_turns_leave_the_other_components(noise):
    played = []
    options = {**NOISY, "turn_noise": 0.5, "turns": [4], "on_episode": played.append}
    demonstrations(NOISY_TASK, 40, noise=noise, **options)
    steps = torch.cat(played)
    same = steps[keys.ACTION] == steps[keys.EXPERT_ACTION]
    others, turn = same[:, :4].all(dim=-1), same[:, 4]
    assert torch.equal(steps[keys.IS_EXPERT].squeeze(-1), others & turn)
    assert others.float().mean() == pytest.approx(1 - noise, abs=0.08)
    assert turn.float().mean() == pytest.approx((1 - noise) * 0.5, abs=0.08)
    drawn = steps[keys.ACTION][~turn, 4]
    assert drawn.min() < -0.8
    assert drawn.max() > 0.8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": 0.1, "source": "deconstruction"}, "noise"),
        ({"noise": -0.1}, "noise: .* -0.1"),
        ({"noise": 1.5}, "noise: .* 1.5"),
        ({"turn_noise": 1.5, "turns": [4]}, "turn_noise: .* 1.5"),
        ({"turn_noise": 0.1}, "turn_noise: the actions have no turns"),
    ],
)
def test_noise_that_cannot_be_added_is_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        collect_demonstrations(None, 1, **settings)


def test_random_actions_keep_the_primitive_that_the_gripper_can_execute():
    steps = torch.cat(demonstrations(TASK, 10, num_envs=2, env=ENV, noise=0.4, primitive=0))
    is_random = ~steps[keys.IS_EXPERT].squeeze(-1)
    assert is_random.sum() > 10
    holding = steps[keys.HOLDING].to(steps[keys.ACTION].dtype)
    assert torch.equal(steps[keys.ACTION][:, :1], holding)
    drawn, expert = (steps[key][is_random, 1:] for key in (keys.ACTION, keys.EXPERT_ACTION))
    assert (drawn != expert).all()
