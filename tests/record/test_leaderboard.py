"""The leaderboard and the results page: what is in the table, and what is left out."""

import re

import numpy as np
import pytest
from safetensors.numpy import save_file

from ba_torchrl import list_tasks
from ba_torchrl.commands import leaderboard as command
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record import leaderboard as boards
from ba_torchrl.record.leaderboard import leaderboard
from ba_torchrl.record.results import read_result
from ba_torchrl.record.summary import Run, Section, grouped, load_runs
from ba_torchrl.tasks.base import TASKS
from docs import results as page
from tests.record.test_report import PICK, REACH, policy_test, texts, write_run

ALL_TASKS = "<!-- results: begin -->\nold\n<!-- results: end -->\nend"
QUESTION = "<!-- mine: begin -->\nold\n<!-- mine: end -->\nend"


def make_run(folder, rate=0.9, **changes):
    """Return a run of block reaching with 200 test episodes, of the present versions."""
    robot = {"env": {"robot": "kuka"}}
    values = {"expert_version": TASKS[REACH].expert_version, "config": robot, **changes}
    values = {
        "task_version": TASKS[REACH].version,
        "last": policy_test(rate, episodes=200),
    } | values
    write_run(folder, (0.1, 0.5, rate), **{"benchmark": None, **values})
    return Run(folder, read_result(folder))


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Return an empty folder in the place of the shipped policies."""
    folder = tmp_path / "policies"
    folder.mkdir()
    monkeypatch.setattr(boards, "POLICIES", folder)
    monkeypatch.setattr(page, "FOLDER", tmp_path / "questions")
    (tmp_path / "questions/mine").mkdir(parents=True)
    return folder


def test_every_task_has_a_row_and_empty_cells_are_visible(tmp_path):
    runs = [make_run(tmp_path / "a"), make_run(tmp_path / "b", task=PICK, label="bc cnn")]
    header, *rows = leaderboard(runs, [], list_tasks(), protocol=1).rows()
    assert header == ("task", "method", "success")
    assert [row[0] for row in rows] == list_tasks()
    cells = {task: cells for task, *cells in rows}
    assert cells.pop(REACH) == ["sacfd equi", "0.90 (0.85 to 0.93) 1×200*"]
    assert cells.pop(PICK) == ["bc cnn", "0.90 (0.85 to 0.93) 1×200*"]
    assert all(row == ["–", "–"] for row in cells.values())


def test_five_seeds_are_no_mere_direction(tmp_path):
    runs = [make_run(tmp_path / str(seed), seed=seed) for seed in range(5)]
    (_, (_, _, cell)) = leaderboard(runs, [], [REACH], protocol=1).rows()
    assert re.fullmatch(r"0\.90 \(0\.8\d to 0\.9\d\) 5×200", cell)


def test_all_runs_of_other_versions_are_left_out_and_named(tmp_path):
    others = {
        "protocol 0 instead of 1": {"protocol": 0},
        "task version 9 instead of 0": {"task_version": 9},
        "expert version 9 instead of 0": {"expert_version": 9},
        "100 test episodes, fewer than 200": {"last": policy_test(0.9, episodes=100)},
        "its task is not registered; name its plugins": {"task": "mine/push"},
    }
    runs = [make_run(tmp_path / str(n), **each) for n, each in enumerate(others.values())]
    runs += [make_run(tmp_path / "none", expert_version=None)]
    board = leaderboard([], runs, [REACH], protocol=1)
    assert [len(group.runs) for group in board.groups] == [1]
    for text, run, why in zip(board.left_out, runs, others, strict=False):
        assert text.endswith(f"seed 0 ({run.folder}): {why}")
    assert len(board.left_out) == len(others)


def test_own_runs_are_beside_those_of_the_package(tmp_path):
    packaged, own = make_run(tmp_path / "a"), make_run(tmp_path / "b", 0.5)
    board = leaderboard([packaged], [packaged, own], [REACH], protocol=1)
    assert [group.method for group in board.groups] == ["sacfd equi", "sacfd equi, own"]
    assert list(board.rows())[-1][-1].startswith("0.50")
    assert len(leaderboard([packaged], [packaged], [REACH], protocol=1).groups) == 1
    with pytest.raises(ConfigError, match=r"same settings and seed: .*/a, .*/b"):
        leaderboard([], [packaged, own], [REACH], protocol=1)


@pytest.mark.usefixtures("shipped")
def test_the_command_prints_the_table(tmp_path, capsys):
    make_run(tmp_path / "runs/a", label="my method")
    make_run(tmp_path / "runs/b", label="older", protocol=0)
    (tmp_path / "runs/c").mkdir()
    (tmp_path / "runs/c/config.json").write_text("{}")
    command.COMMAND.run([str(tmp_path / "runs")])
    text = capsys.readouterr().out
    assert re.search(rf"^\| {REACH}  +\| my method \| 0\.90 \(", text, flags=re.MULTILINE)
    assert re.search(rf"^\| {PICK}  +\| –  +\| –  +\|$", text, flags=re.MULTILINE)
    assert "older, seed 0" in text
    assert f"- {tmp_path / 'runs/c'}: interrupted" in text
    command.COMMAND.run([])  # no policies
    text = capsys.readouterr().out
    assert all(f"\n| {task} " in text for task in list_tasks())


def test_the_page_of_results_is_made_from_the_shipped_policies(tmp_path, shipped):
    tasks = [task for task in TASKS if TASKS.plugin_module(task) is None]
    assert len(re.findall(r"^\| `", page.page_with_results(ALL_TASKS), flags=re.MULTILINE)) == len(
        tasks
    )
    machine = {"hardware": {"cpu": "Old CPU"}, "versions": {"commit": "0ld"}}
    of_file = {"policy_file": "0f", "trained_on": machine, "curve": [], "seconds": None}
    for seed in range(2):
        run = make_run(tmp_path / f"{seed}", seed=seed, **of_file, env_steps=None)
        texts = {"result": run.result.model_dump_json()}
        save_file({"weights": np.zeros(2)}, shipped / f"{seed}.safetensors", texts)
    text = page.page_with_results(ALL_TASKS).replace("\N{NO-BREAK SPACE}", " ")
    (row,) = re.findall(r"^\| `close_loop/block_reaching` .*", text, flags=re.MULTILINE)
    assert row.split(" | ")[2::2] == ["sacfd equi", "6.0", "– |"]
    assert "2×200*" in row
    assert "Trained on Old CPU: 2 policies; commits: 0ld." in text
    assert "Processors: Some CPU; commits: abc." in text


@pytest.mark.usefixtures("shipped")
def test_the_results_of_a_question_are_compared(tmp_path):
    for seed in range(2):
        for rate, label in ((0.9, "first"), (0.4, "second")):
            name = f"runs/{label}{seed}"
            make_run(tmp_path / name, rate, seed=seed, label=label, benchmark="mine")
    assert page.add([str(tmp_path / "runs")]) == 4
    text = page.page_with_results(QUESTION)
    assert "results/mine.svg" in text
    first, second, difference = re.findall(rf"^\| `{REACH}` .*", text, flags=re.MULTILINE)
    assert [row.split(" | ")[1] for row in (first, second)] == ["first", "second"]
    assert first.split(" | ")[4] > second.split(" | ")[4]  # of the last policy
    *names, area, _, last, _ = difference.split(" | ")
    assert names[1:] == ["first", "second", "2"]
    assert (area.split(" ")[0], last.split(" ")[0]) == ("+0.13", "+0.50")
    assert difference.endswith("direction only |")
    make_run(tmp_path / "runs/other", 0.1, label="first", benchmark="mine", env_steps=7)
    with pytest.raises(ValueError, match=r"runs/first0 and .*runs/other are both .*_seed0\.json"):
        page.add([str(tmp_path / "runs")])
    make_run(tmp_path / "alone")
    with pytest.raises(ValueError, match=r"alone is no run of a question: there is no .*/None"):
        page.add([str(tmp_path / "alone")])


def test_methods_of_several_numbers_of_demonstrations_are_drawn_over_these(tmp_path):
    for number, label in ((20, "bc cnn 20"), (5, "bc cnn 5"), (20, "bc cnn 20 noisy")):
        make_run(tmp_path / label, number / 40, label=label, benchmark="m", demonstrations=number)
    section = Section("m", grouped(load_runs([str(tmp_path)])[0]))
    page.plot_demonstrations(section, tmp_path / "one.svg")
    found = texts(tmp_path / "one.svg")
    assert {"bc cnn", "demonstrations", REACH} <= {*found}
    assert "noisy" not in " ".join(found)
    page.plot_demonstrations(Section("m", section.groups[:1]), tmp_path / "none.svg")
    assert not (tmp_path / "none.svg").exists()
