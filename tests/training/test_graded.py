"""Graded sets of episodes for offline learning."""

import shutil
from collections import Counter
from types import SimpleNamespace

import pytest
import torch

from ba_torchrl.algorithms.base import SeedUse, derive_seed
from ba_torchrl.commands import graded as command
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import atomic_output
from ba_torchrl.demonstrations import load_demonstrations
from ba_torchrl.demonstrations.demo_files import read_metadata
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import graded
from ba_torchrl.training.graded import GRADES, GradedSets
from tests.demonstrations.test_formats import assert_equal

TASK, ENV = "close_loop/block_reaching", {"obs_size": 64, "max_steps": 8}


@pytest.fixture
def rates(monkeypatch):
    """Success rates of the evaluations of medium in their order, one after every two updates."""
    found = [0.5]
    monkeypatch.setattr(graded, "_EVERY", 2)
    monkeypatch.setattr(graded, "evaluate", lambda *_: SimpleNamespace(success_rate=found.pop(0)))
    return found


def made(folder, episodes=4, **changes):
    sets = GradedSets(folder, TASK, episodes, ENV, num_envs=2, parallel=False, **changes)
    for grade in GRADES:
        sets.make(grade)
    return {grade: load_demonstrations(folder / grade, task=TASK, env=ENV) for grade in GRADES}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graded, "_EVERY", 1)
        patch.setattr(graded, "evaluate", lambda *_: SimpleNamespace(success_rate=0.5))
        path = tmp_path_factory.mktemp("sets")
        made(path)
    return path


@pytest.fixture
def sets(folder):
    return {grade: load_demonstrations(folder / grade, task=TASK, env=ENV) for grade in GRADES}


def test_a_set_that_another_process_makes_is_refused_before_it_plays(tmp_path, monkeypatch):
    monkeypatch.setattr(graded, "collect_episodes", None)
    with atomic_output(tmp_path / "random"), pytest.raises(ConfigError, match=r"writes .*random"):
        made(tmp_path)


def test_every_grade_has_its_card_and_executed_actions_only(folder, sets):
    for grade, episodes in sets.items():
        card = read_metadata(folder / grade)
        returns = [float(each["next", "reward"].sum()) for each in episodes]
        successes = [bool(each["next", "success"][-1]) for each in episodes]
        assert (card["source"], card["episodes"]) == (grade, 4)
        assert card["success_rate"] == sum(successes) / 4
        assert card["mean_return"] == sum(returns) / 4
        assert {"action", "depth"} <= set(episodes[0].keys())
        assert not {"expert_action", "is_expert"} & set(episodes[0].keys())
    assert read_metadata(folder / "expert")["success_rate"] == 1
    policy = read_metadata(folder / "medium")["policy"]
    assert policy == "bc cnn, 4 episodes of the expert, 1 updates, success 0.50 of 50"


def test_random_actions_fill_their_range_and_none_is_the_experts(sets):
    actions = torch.cat(sets["random"])["action"]
    assert not torch.isin(actions[:, 0], torch.cat(sets["expert"])["action"][:, 0]).any()
    assert actions.min() < -0.8
    assert actions.max() > 0.8
    assert actions.abs().mean() == pytest.approx(0.5, abs=0.1)


def test_mixed_has_equal_parts_in_turn(sets):
    first = [sets[grade][0] for grade in ("random", "medium", "expert")]
    assert_equal(sets["mixed"], [*first, sets["random"][1]])


def test_a_set_is_made_again_with_the_same_episodes_and_others_stay(
    folder, sets, tmp_path, rates, monkeypatch
):
    shutil.copytree(folder, tmp_path / "sets")
    shutil.rmtree(tmp_path / "sets" / "random")
    shutil.rmtree(tmp_path / "sets" / "expert")
    kept = (tmp_path / "sets" / "medium").stat()
    again = made(tmp_path / "sets")
    for grade in GRADES:
        assert_equal(again[grade], sets[grade])
    assert (tmp_path / "sets" / "medium").stat().st_ino == kept.st_ino
    assert rates == [0.5]  # nothing was trained
    with pytest.raises(ConfigError, match=r"random holds another set .seed, episodes differ"):
        made(tmp_path / "sets", episodes=5, seed=1)
    monkeypatch.setattr(TASKS[TASK], "expert_version", 1)
    with pytest.raises(ConfigError, match=r"random holds another set .expert_version differ"):
        made(tmp_path / "sets")
    other = GradedSets(tmp_path / "other", TASK, 4, ENV, seed=1, num_envs=2, parallel=False)
    other.make("random")
    found = load_demonstrations(tmp_path / "other" / "random", task=TASK, env=ENV)
    assert not torch.equal(found[0]["action"], sets["random"][0]["action"])


def test_no_seed_of_a_set_is_one_of_a_run():
    sets = GradedSets("", TASK, 1, num_envs=1024)
    used = Counter(sets.seed_of(grade) + i for grade in GRADES[:3] for i in range(sets.num_envs))
    for use in SeedUse:
        used.update(derive_seed(sets.seed, use) + i for i in range(sets.num_envs))
    assert max(used.values()) == 1


def test_training_of_medium_goes_back_where_success_passes_over_half(
    sets, rates, monkeypatch, tmp_path
):
    build, learners = graded.build_learner, []
    monkeypatch.setattr(
        graded, "build_learner", lambda config: learners.append(build(config)) or learners[0]
    )
    rates[:] = [0.1, 0.9, 0.5]
    _, text = graded.half_trained(GradedSets(tmp_path, TASK, 4, ENV), None, sets["expert"])
    assert "3 updates, success 0.50" in text  # 2, then 4, then 2 + 1
    assert learners[0].updates == 3
    assert rates == []


@pytest.mark.parametrize("found", [[0.9, 0.9], [0.0, 0.0]])
def test_a_task_without_half_success_is_refused(sets, rates, found, monkeypatch, tmp_path):
    monkeypatch.setattr(graded, "MOST_UPDATES", 4)
    rates[:] = found
    with pytest.raises(ConfigError, match="no policy of at most 4 updates"):
        graded.half_trained(GradedSets(tmp_path, TASK, 4, ENV), None, sets["expert"])
    assert rates == []


def test_the_command_makes_all_sets_and_flags_a_medium_far_from_half(
    tmp_path, rates, monkeypatch, capsys
):
    words = "episodes=3 num_envs=1 parallel=false env.obs_size=64 env.max_steps=4"
    task, path = f"tasks=[{TASK}]", f"path={tmp_path}"
    with pytest.raises(ConfigError, match=r"medium: success is not from 0.3 to 0.7"):
        command.COMMAND.run.__wrapped__(command.COMMAND, [*words.split(), task, path])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines if line.startswith(TASK)] == [
        f"{TASK} {grade}" for grade in GRADES
    ]
    assert all((tmp_path / TASK / grade).is_dir() for grade in GRADES)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("env.obs_size=32", "this network takes images of 64 or 128 px, got 32"),
        ("env.obs_type=vec", "the networks take images"),
        ("env.obs_sze=3", "unknown parameter 'obs_sze'"),
        (f"tasks=[{TASK},{TASK}]", "tasks: name each one once"),
    ],
)
def test_the_command_refuses_settings_before_it_makes_a_set(tmp_path, word, message):
    words = [f"tasks=[{TASK}]", f"path={tmp_path}/new"]
    words = [word, words[1]] if word.startswith("tasks") else [word, *words]
    with pytest.raises(ConfigError, match=message):
        command.COMMAND.run.__wrapped__(command.COMMAND, words)
    assert not list(tmp_path.glob("new/*"))


def test_random_actions_of_open_loop_have_the_primitive_that_has_an_effect(tmp_path):
    task, env = "open_loop/block_stacking", {"obs_size": 64}
    sets = GradedSets(tmp_path, task, 2, env, num_envs=1, parallel=False)
    sets.make("random")
    steps = torch.cat(load_demonstrations(tmp_path / "random", task=task, env=env))
    assert torch.equal(steps["action"][:, :1] > 0.5, steps["holding"])
    assert steps["action"][:, 1].std() > 0.05
