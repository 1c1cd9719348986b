import csv
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from ba_torchrl.algorithms.imitation_config import DAggerConfig
from ba_torchrl.commands import leaderboard, report
from ba_torchrl.core.config import FIRST_TEST_SEED
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.plots import Learning, plot_panels
from ba_torchrl.record.report import plot_groups, write_report
from ba_torchrl.record.results import (
    PolicyTest,
    RunResult,
    differences,
    read_result,
    versions,
    why_unfinished,
    write_result,
)
from ba_torchrl.record.summary import (
    Run,
    compare,
    differing_settings,
    load_runs,
    sections,
    summarize,
)
from tests.recipes import recipe

imageio = pytest.importorskip("imageio.v3")

ROOT = Path(__file__).parents[2]
REACH, PICK = "close_loop/block_reaching", "close_loop/block_picking"
UPDATES = (100, 200, 300)
BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"


def load(root, changes=lambda _: {}):
    """Return the sections of the runs below a folder."""
    return sections(load_runs([root])[0], changes)


def write(roots, folder, changes=lambda _: {}):
    """Write the report of the runs below some folders."""
    runs, unfinished = load_runs(roots)
    return write_report(sections(runs, changes), unfinished, folder)


def policy_test(rate, seed=0, episodes=10):
    successes = round(rate * episodes)
    outcomes = [1] * successes + [0] * (episodes - successes)
    lengths = [6 + seed] * episodes
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + episodes)
    return PolicyTest(updates=300, seeds=seeds, successes=outcomes, lengths=lengths)


RESULT = {
    "task": REACH,
    "label": "sacfd equi",
    "benchmark": "close_loop_4d",
    "protocol": 1,
    "task_version": 0,
    "expert_version": 0,
    "demonstrations": 5,
    "demonstration_steps": 400,
    "env_steps": 1500,
    "expert_labels": 0,
    "precision": "float32",
    "parameters": 1000,
    "phase_seconds": {"updates": 1800.0},
    "versions": {"python": "3.11.0", "torch": "2.13.0", "ba_torchrl": "0.1.0", "commit": "abc"},
    "hardware": {"cpu": "Some CPU", "cores": 2, "memory_gb": 8.0, "gpu": None, "threads": 2},
    "finished": "2000-01-01T00:00:00+00:00",
    "files": {},
}
"""Entries of the result of a run, without those of its curve and of its tests."""


def write_run(folder, rates, *, seed=0, final=None, updates=UPDATES, **changes):
    """Write the files of a finished run; ``rates`` are the success rates of the curve."""
    folder.mkdir(parents=True)
    values = {**RESULT, **changes}
    config = {"seed": seed, "env": {"obs_size": 64}, "run_dir": str(folder)}
    values["config"] = {"task": values["task"], **config, **changes.get("config", {})}
    point = {"seconds": 60.0, "episodes": 10, "standard_error": 0.1, "mean_length": 7.0}
    own = {
        "seed": seed,
        "curve": [
            {"updates": at, "env_steps": 5 * at + seed, "success_rate": rate, **point}
            for at, rate in zip(updates, rates, strict=False)
        ],
        "last": policy_test(rates[-1] if final is None else final, seed),
        "best": policy_test(max(rates, default=final), seed),
        "seconds": 1800.0 + 360 * seed,
    }
    write_result(folder, RunResult(**{**own, **values}))
    return folder


def test_versions_name_the_commit_in_a_clone():
    command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode or not (ROOT / ".git").exists():
        pytest.skip("this is no clone")
    assert found.stdout.startswith(versions()["commit"].rstrip("+"))


def test_the_curve_of_a_group_is_of_the_runs_that_have_one(tmp_path):
    write_run(tmp_path / "0", (), final=0.4)
    write_run(tmp_path / "1", (0.1, 0.6), seed=1)
    (group,) = load(tmp_path)[0].groups
    assert group.curve.value.tolist() == [0.1, 0.6]
    assert group.success.value == pytest.approx(0.5)
    assert write([tmp_path], tmp_path / "report").is_file()


def test_curves_begin_with_the_untrained_policy_if_all_runs_have_its_evaluation(tmp_path):
    write_run(tmp_path / "new" / "seed0", (0.2, 0.5, 0.9), updates=(0, 100, 200))
    (section,) = load(tmp_path)
    assert section.groups[0].axis("updates").tolist() == [0, 100, 200]
    assert summarize(section)[0]["area"] == pytest.approx(0.525)  # of 0.35 and 0.7
    write_run(tmp_path / "old" / "seed1", (0.5, 0.9, 0.9), seed=1, updates=(100, 200, 300))
    (section,) = load(tmp_path)
    (group,) = section.groups
    assert group.axis("updates").tolist() == [100, 200, 300]
    assert group.curve.value.tolist() == [0.5, 0.9, 0.9]


def test_areas_are_over_updates_if_no_method_takes_a_step(tmp_path):
    point = {"env_steps": 0, "seconds": 1, "episodes": 10, "standard_error": 0.1, "mean_length": 7}
    curve = [{"updates": 100 * i, "success_rate": rate, **point} for i, rate in enumerate((0.2, 1))]
    write_run(tmp_path / "bc", (0.2, 1.0), label="bc", curve=curve, env_steps=0)
    (section,) = load(tmp_path)
    assert summarize(section)[0]["area"] == pytest.approx(0.6)
    plot_groups(section.groups, [tmp_path / "curves.svg"])
    assert "environment steps" not in (svg := (tmp_path / "curves.svg").read_text())
    assert "updates" in svg
    write_run(tmp_path / "sac", (0.0, 0.4), updates=(0, 200), label="sac")
    areas = {row["method"]: row["area"] for row in summarize(load(tmp_path)[0])}
    assert areas == pytest.approx({"bc": 1.0, "sac": 0.2})


def test_figures_over_seeds(tmp_path):
    curves = {0: (0.1, 0.8, 0.9), 1: (0.3, 0.9, 1.0), 2: (0.2, 0.6, 0.7), 3: (0.2, 0.7, 0.9)}
    for seed, rates in curves.items():
        write_run(tmp_path / f"seed{seed}", rates, seed=seed)
    (section,) = load(tmp_path)
    (row,) = summarize(section)
    assert (row["task"], row["method"], row["seeds"]) == (REACH, "sacfd equi", 4)
    assert row["success"] == pytest.approx(0.875)
    # means of the halves: 0.2, 0.75 and 0.875
    assert section.groups[0].curve.value == pytest.approx([0.2, 0.75, 0.875])
    assert row["best"] == pytest.approx(0.875)
    assert row["area"] == pytest.approx((0.475 + 0.8125) / 2, abs=0.001)
    assert row["updates_to_80"] == 300
    assert row["env_steps_to_80"] == pytest.approx(1501.5)
    assert row["mean_length"] == pytest.approx(7.5)
    assert row["hours"] == pytest.approx(0.65)
    assert 0 < row["low"] < 0.7 < row["success"] < row["high"] <= 1  # ten episodes


def test_the_last_point_of_a_run_that_ended_early_stands_for_later_ones(tmp_path):
    for seed, rates in enumerate([(0.1, 0.5, 0.7), (0.9, 0.9)]):
        write_run(tmp_path / f"seed{seed}", rates, seed=seed)
    (section,) = load(tmp_path)
    (group,) = section.groups
    assert group.axis("updates").tolist() == list(UPDATES)
    assert group.axis("env_steps").tolist() == [500, 1000, 1500]
    assert group.curve.value == pytest.approx([0.5, 0.7, 0.8])
    # at the last point the seeds have 1500 and 1001 steps
    assert group.reaches(0.8) == (300.0, 1250.5)


def test_the_row_of_all_tasks_has_methods_that_ran_on_all_of_them(tmp_path):
    for seed, (limits, pick) in enumerate([(1.0, 0.5), (0.8, 0.1)]):
        rates = (0.0, 0.0)
        write_run(tmp_path / f"reach{seed}", (*rates, limits), seed=seed)
        write_run(tmp_path / f"pick{seed}", (*rates, pick), seed=seed, task=PICK)
    write_run(tmp_path / "other", (0.0, 0.0, 0.0), label="sac cnn")
    (section,) = load(tmp_path)
    rows = summarize(section)
    assert [(row["task"], row["method"]) for row in rows] == [
        (PICK, "sacfd equi"),
        (REACH, "sac cnn"),
        (REACH, "sacfd equi"),
        ("all tasks", "sacfd equi"),
    ]
    together = rows[-1]
    assert together["success"] == pytest.approx(0.6)
    assert together["low"] < 0.6 < together["high"]
    assert (together["seeds"], together["episodes"]) == (2, 10)
    assert list(together) == list(rows[0])


def test_the_settings_in_which_methods_differ_are_listed(tmp_path):
    for task, steps in ((REACH, 50), (PICK, 100)):
        for label in ("sac cnn", "sac equi"):
            env = {"obs_size": 64, "max_steps": steps}
            config = {"network": {"name": label.split()[1]}, "tau": 0.01, "env": env}
            folder = tmp_path / f"{label}{steps}"
            write_run(folder, (0, 0, 1), label=label, task=task, config=config)
    write_run(tmp_path / "c", (0, 0, 1), label="sac ferm", config={"network": {"name": "ferm"}})
    (section,) = load(tmp_path)
    found = [tuple(row.values()) for row in differing_settings(section)]
    assert [row for row in found if not row[0].startswith("env")] == [
        ("network.name", "cnn", "sac cnn"),
        ("network.name", "equi", "sac equi"),
        ("network.name", "ferm", "sac ferm"),
        ("tau", "0.01", "sac cnn, sac equi"),
        ("tau", "–", "sac ferm"),
    ]


def test_runs_with_other_values_do_not_have_the_name_of_the_benchmark(tmp_path):
    for seed in range(2):
        write_run(tmp_path / f"a{seed}", (0, 0, 1), seed=seed)
    write_run(tmp_path / "b", (0, 0, 1), label="sac cnn")

    def changes(run):
        return {"tau": (0.5, 0.1)} if run.label == "sac cnn" else {}

    same, changed = load(tmp_path, changes)
    assert (same.title, len(same.groups[0].runs)) == ("close_loop_4d", 2)
    assert changed.title == "close_loop_4d, changed"
    assert changed.changes == ["tau is 0.5 instead of 0.1"]
    page = write([tmp_path], tmp_path / "report", changes=changes).read_text()
    assert "tau is 0.5 instead of 0.1" in page
    assert "tau is 0.5 instead of 0.1" in (tmp_path / "report/table.md").read_text()


def test_runs_with_equal_settings_are_averaged_however_they_are_written(tmp_path):
    for seed, config in enumerate([{"tau": 1, "x": None, "y": (1, 2)}, {"y": [1, 2], "tau": 1.0}]):
        write_run(tmp_path / str(seed), (0, 0, 1), seed=seed, config=config)
    (section,) = load(tmp_path)
    assert [len(group.runs) for group in section.groups] == [2]


def test_runs_with_other_settings_are_not_averaged(tmp_path):
    write_run(tmp_path / "a", (0, 0, 0), seed=0)
    write_run(tmp_path / "b", (0, 0, 0), seed=1)
    write_run(tmp_path / "c", (1, 1, 1), seed=0, config={"env": {"obs_size": 128}})
    write_run(tmp_path / "d", (0, 0, 0), seed=2, config={"threads": 4, "device": "cuda"})
    (section,) = load(tmp_path)
    found = {group.method: [run.result.seed for run in group.runs] for group in section.groups}
    assert found == {
        "sacfd equi (env.obs_size 64)": [0, 1, 2],
        "sacfd equi (env.obs_size 128)": [0],
    }


OTHERS = {"task_version": 1, "expert_version": None, "protocol": 0, "precision": "bfloat16"}
OTHERS["policy_file"] = "0f"


@pytest.mark.parametrize("name", OTHERS)
def test_runs_of_other_versions_are_rows_of_their_own_whose_names_say_so(tmp_path, name):
    write_run(tmp_path / "a", (0, 0, 0.5))
    write_run(tmp_path / "b", (0, 0, 0.5), seed=1)
    write_run(tmp_path / "c", (0, 0, 0.5), task=PICK)
    write_run(tmp_path / "d", (0, 0, 1), seed=2, **{name: OTHERS[name]})
    (section,) = load(tmp_path)
    of_task = section.of_task(REACH)
    assert sorted(len(group.runs) for group in of_task) == [1, 2]
    assert all(f"({name.split('_')[0]}" in group.method for group in of_task)
    (row,) = (row for row in compare(section) if row["task"] == REACH)
    assert row["reading"].startswith("not compared: ")
    if name in ("task_version", "protocol"):
        assert f"other {name.replace('_', ' ')}" in row["reading"]
    # no method of all tasks has runs of two protocols
    methods = {row["method"] for row in summarize(section) if row["task"] == "all tasks"}
    assert len(methods) == (name in ("protocol", "precision", "policy_file"))


def test_comparisons_have_area_and_late_success_and_name_settings_beside_the_arms(tmp_path):
    arms = {"sac cnn": ((0.0, 0.2, 0.4), {}), "sac equi": ((0.4, 0.8, 0.6), {"demonstrations": 9})}
    arms["sac equi more"] = ((1, 1, 1), {"demonstrations": 99})
    for label, (rates, config) in arms.items():
        for seed in range(2):
            changed = {**config, "algorithm": {"name": "sac"}, "network": {"name": label}}
            write_run(tmp_path / f"{label}{seed}", rates, seed=seed, label=label, config=changed)
    (section,) = load(tmp_path)
    rows = {(row["first"], row["second"]): row for row in compare(section)}
    row = rows["sac cnn", "sac equi"]
    assert (row["area"], row["late"]) == pytest.approx(
        (-0.45, -0.4), abs=1e-3
    )  # of 0.2 and 0.65, 0.2 and 0.6
    assert row["reading"] == "direction only; also differ in demonstrations"
    assert rows["sac equi", "sac equi more"]["reading"] == "direction only"


def test_benchmarks_have_sections_and_other_runs_are_last(tmp_path):
    for name in (None, "close_loop_4d", "close_loop_3d"):
        write_run(tmp_path / str(name), (0, 0, 1), benchmark=name)
    assert [section.title for section in load(tmp_path)] == [
        "close_loop_3d",
        "close_loop_4d",
        "runs",
    ]


def test_two_runs_of_one_seed_are_refused(tmp_path):
    for name, rate in (("a", 0), ("b", 1)):
        write_run(tmp_path / name, (0, 0, rate))
    for name, rate in (("c", 0), ("d", 1)):
        write_run(tmp_path / name, (0, 0, rate), task=PICK)
    every = r"settings and seed: .*/a, .*/b; .*/c, .*/d; name the folders"
    with pytest.raises(ConfigError, match=every):
        load(tmp_path)


def test_a_copy_of_a_run_is_left_out(tmp_path, caplog):
    write_run(tmp_path / "a", (0, 0, 1))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    (section,) = load(tmp_path)
    assert [run.folder.name for run in section.groups[0].runs] == ["a"]
    assert f"{tmp_path / 'b'} is a copy of {tmp_path / 'a'}" in caplog.text


def test_folders_without_results_are_refused(tmp_path, capsys):
    for text in (None, '{"format": 2}'):  # none, and one that cannot be read
        if text is not None:
            (tmp_path / "result.json").write_text(text)
        with pytest.raises(SystemExit):
            recipe("report", str(tmp_path))
        assert "no finished run below " in capsys.readouterr().err


def test_a_result_is_read_as_it_was_written(tmp_path):
    folder = write_run(tmp_path / "a", (0.25, 0.5, 1.0), seed=3)
    result = read_result(folder)
    assert [point.success_rate for point in result.curve] == [0.25, 0.5, 1.0]
    assert result.last.mean_length == 9.0
    assert [path.name for path in folder.iterdir()] == ["result.json"]


OTHER_SEEDS = "the seeds are not those of protocol 1"


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        (("last", "seeds"), [*range(10)], OTHER_SEEDS),
        (("last", "seeds"), [FIRST_TEST_SEED] * 10, OTHER_SEEDS),
        (("best", "seeds"), [-1, *range(9)], "at least 0"),
        (("last", "lengths"), [-6] * 10, "at least 1"),
        (("last", "lengths"), [6] * 9, "every episode has a seed, a success and a length"),
        (("curve", 0, "success_rate"), 9.0, "at most 1"),
        (("curve", 0, "success_rate"), -1.0, "at least 0"),
        (("curve", 0, "standard_error"), 9.0, "at most 1"),
        (("curve", 1, "updates"), 100, "the updates of the points do not rise"),
        (("curve", 0, "episodes"), 0, "at least 1"),
        (("env_steps",), 2**53, "less than 9007199254740992"),
        (("seconds",), -1.0, "at least 0"),
        (("seed",), -1, "at least 0"),
        (("versions",), {}, "without the version of python and ba_torchrl"),
        (("files", "video"), "/etc/hostname", "/etc/hostname is not a path inside the run folder"),
        (("files", "video"), "a/../../other.mp4", "is not a path inside the run folder"),
    ],
)
def test_a_result_that_no_run_can_have_is_left_out_with_the_reason(tmp_path, path, value, reason):
    file = write_run(tmp_path / "run", (0.1, 0.6)) / "result.json"
    values = part = json.loads(file.read_text())
    for step in path[:-1]:
        part = part[step]
    part[path[-1]] = value
    file.write_text(json.dumps(values))
    with pytest.raises(ConfigError, match=re.escape(reason)) as error:
        read_result(tmp_path / "run")
    assert ".".join(map(str, path[:1])) in str(error.value)
    runs, unfinished = load_runs([tmp_path])
    assert (runs, unfinished) == ([], [tmp_path / "run"])
    assert reason in why_unfinished(tmp_path / "run")


def test_a_run_of_somebody_else_imports_and_copies_nothing_from_outside_its_folder(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ba_torchrl.record.leaderboard.POLICIES", tmp_path / "none")
    Path("evil.py").write_text("open('CODE_RAN', 'w')")
    Path("secret.mp4").write_text("secret")
    config = {"plugins": ["evil"]}
    files = {"video": "film.mp4"}
    write_run(Path("runs/a"), (0.1, 0.6), config=config, files=files, benchmark=None)
    write_run(Path("runs/b"), (0.1, 0.6), config=config, files=files, benchmark=None, seed=1)
    pasted = "x]'; rm -rf /; '"
    own = {"config": {"plugins": [pasted]}, "files": {"video": "long" * 99}}
    write_run(Path("runs/c"), (0.1,), **own, label="\x00\x1b[31m", final=0.5)
    Path("runs/a/film.mp4").symlink_to("../../secret.mp4")
    Path("runs/b/own.mp4").write_text("own")
    Path("runs/b/film.mp4").symlink_to("own.mp4")
    for module in (report, leaderboard):
        caplog.clear()
        module.COMMAND.run(["runs"])
        warning, other = caplog.messages
        assert "uses the plugins [evil]" in warning
        assert "If you trust them, add 'plugins=[evil]'" in warning
        assert repr(pasted) in other
        assert "add " not in other
    assert not Path("CODE_RAN").exists()
    films = {path.name: path.read_text() for path in Path("runs/report").rglob("*.mp4")}
    assert films == {"close_loop_block_reaching_sacfd_equi_seed1.mp4": "own"}
    for file in Path("runs/report").rglob("*.svg"):
        ElementTree.parse(file)


def test_the_texts_of_a_run_are_texts_in_every_file(tmp_path):
    label = "=1+1 <img src=x onerror=alert(1)> | [x](http://x)\n# $a_{$"
    for number, task in enumerate(("mine/a_b", "mine_a/b", "mine_A/b")):
        write_run(tmp_path / f"runs/{number}", (0.1, 0.6), label=label, task=task, final=0.0)
        write_run(tmp_path / f"runs/-{number}", (0.1, 0.6), label="-0.81", task=task)
    page = Page(write([tmp_path / "runs"], tmp_path / "report"))
    folder = tmp_path / "report"
    figures = [source for source in page.sources if source]
    assert len({figure.casefold() for figure in figures}) == len(figures) == 3
    assert all((folder / figure).is_file() for figure in figures)
    assert label.split("\n")[0] in " ".join(texts(folder / figures[0])).replace("\n", " ")
    text = (folder / "table.md").read_text()
    assert "=1+1 \\<img src=x onerror=alert(1)> \\| [x\\](http://x) # $a_{$ |" in text
    assert not re.search(r"(?<!\\)<img", text)
    assert "<img src=x onerror" not in page.text
    with (folder / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {f"'{label}", "'-0.81"}
    with (folder / "comparisons.csv").open(newline="") as file:
        assert {row["difference"] for row in csv.DictReader(file)} == {"0.6"}


def test_differences_ignore_fields_that_do_not_change_learning():
    first = {"env": {"a": 1, "b": [1, 2]}, "seed": 0, "run_dir": "x", "label": "one"}
    second = {"env": {"a": 2, "b": [1, 2], "c": 3}, "seed": 1, "run_dir": "y", "label": "two"}
    assert differences(first, second) == {"env.a": (1, 2), "env.c": (None, 3), "seed": (0, 1)}


class Page(HTMLParser):
    """Parser of the page that also checks that every element is closed."""

    def __init__(self, path):
        super().__init__()
        self.sources, self.rows, self.open = [], [], []
        self.text = path.read_text()
        self.feed(self.text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.sources.append(attributes.get("src", ""))
        if tag == "tr":
            self.rows.append([])
        if tag not in ("meta", "img", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] == ["td"] or self.open[-2:] == ["th", "button"]:
            self.rows[-1].append(data)


def lines(path):
    """Return the points of the curves of an SVG by colour, [n, 2] in points from the top left."""
    found = {}
    for d, style in re.findall(
        r'<path d="([^"]*)" clip-path="[^"]*" style="([^"]*)"', path.read_text()
    ):
        color = re.search(r"stroke: (#\w+)", style)
        if color and "stroke-width: 1.5;" in style:
            numbers = [float(word) for word in re.findall(r"[\d.]+", d)]
            found.setdefault(color[1], []).append(np.reshape(numbers, (-1, 2)))
    return found


def texts(path):
    """Return the words of an SVG, which are drawn as shapes, with a comment each."""
    return [html.unescape(text) for text in re.findall(r"<!-- (.*?) -->", path.read_text())]


def test_runs_are_compared_with_the_benchmark_of_the_package(tmp_path):
    text = (ROOT / "configs/benchmark/cpu_six_dof.yaml").read_text()
    updates = int(re.search(r"^total_updates: (\d+)", text, flags=re.MULTILINE)[1])
    folder = write_run(tmp_path / "a", (0, 1), label="dagger asr", task="ramp/block_stacking")
    run = read_result(folder).model_copy(update={"benchmark": "cpu_six_dof"})
    grid = report._planned("cpu_six_dof")[run.task, run.label]
    assert (grid.total_updates, type(grid.algorithm)) == (updates, DAggerConfig)

    def changes(**values):
        config = {**grid.resolved(), "seed": 3, "threads": 7, **values}
        return report.changes(run.model_copy(update={"config": config}))

    assert changes() == {}
    older = {name: value for name, value in grid.resolved().items() if name != "parallel"}
    (completed,) = report.completed([Run(folder, run.model_copy(update={"config": older}))])
    assert completed.result.config.keys() == grid.resolved().keys()
    assert changes(total_updates=updates + 1) == {"total_updates": (updates + 1, updates)}
    (listed,) = report.changes(run.model_copy(update={"label": "sac cnn"}))
    assert listed == "tasks, algorithms and networks"
    for name in ("mine", "../train", "long" * 99):
        assert report.changes(run.model_copy(update={"benchmark": name})) == {}


def test_a_report_is_a_folder_with_curves_tables_and_a_page(tmp_path):
    runs = tmp_path / "runs"
    for task in (REACH, PICK):
        for seed in range(2):
            name = f"{task.split('/')[-1]}{seed}"
            write_run(runs / f"equi{name}", (0.2 + 0.2 * seed, 0.7, 0.9), seed=seed, task=task)
            write_run(
                runs / f"cnn{name}",
                (0.1, 0.2 + 0.1 * seed, 0.4),
                seed=seed,
                task=task,
                label="sacfd <cnn>",
            )
    for seed in range(2):
        folder = runs / f"equiblock_picking{seed}"
        filmed = read_result(folder).model_copy(update={"files": {"video": "evaluation.mp4"}})
        write_result(folder, filmed)
        (folder / "evaluation.mp4").write_bytes(b"film")
    (runs / "broken").mkdir()
    (runs / "broken" / "failure.json").write_text('{"reason": "exit status 1: it broke"}')
    (runs / "stopped").mkdir()
    (runs / "stopped" / "config.json").write_text("{}")

    path = write([runs], tmp_path / "report")
    shutil.rmtree(runs)  # all that the page shows is in its folder
    page, folder = Page(path), path.parent
    assert page.open == []
    video = "videos/close_loop_4d/close_loop_block_picking_sacfd_equi_seed0.mp4"
    assert [source for source in page.sources if source] == [
        "close_loop_4d/close_loop_block_picking.svg",
        "close_loop_4d/close_loop_block_reaching.svg",
        video,
    ]
    linked = re.findall(r'href="([^"]*)"', page.text)
    assert video.replace("seed0", "seed1") in linked
    assert {"close_loop_4d.pdf", "table.csv", "seeds.csv", "curves.csv"} < {*linked}
    assert all((folder / each).stat().st_size for each in [*filter(None, page.sources), *linked])
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page.text)
    assert "sacfd &lt;cnn&gt;" in page.text
    assert "it broke" in page.text
    assert "stopped: interrupted" in page.text
    rows = {(row[0], row[1]): row for row in page.rows[1:] if len(row) == len(page.rows[0])}
    assert len(rows) == 6
    assert rows[REACH, "sacfd equi"][2:6] == ["2", "10", "0.900", "0.596 to 1.000"]
    assert rows[REACH, "sacfd equi"][8:10] == ["0.633", "300"]
    assert rows["all tasks", "sacfd equi"][4] == "0.900"

    def table(name):
        with (folder / name).open() as file:
            return list(csv.DictReader(file))

    assert len(table("table.csv")) == 6
    assert {float(row["success"]) for row in table("table.csv")} == {0.9, 0.4}
    comparisons = {row["task"]: row for row in table("comparisons.csv")}
    assert {*comparisons} == {REACH, PICK, "all tasks"}
    for row in comparisons.values():
        assert (row["first"], row["second"]) == ("sacfd <cnn>", "sacfd equi")
        assert float(row["difference"]) == pytest.approx(-0.5)
        assert (row["seeds"], row["reading"]) == ("2", "direction only")
    assert [(row["seed"], row["success_rate"]) for row in table("seeds.csv")[:2]] == [
        ("0", "0.4"),
        ("1", "0.4"),
    ]
    of_seed = [row for row in table("curves.csv") if row["seed"] == "1" and row["task"] == REACH]
    assert [(row["method"], row["updates"], row["env_steps"]) for row in of_seed[:2]] == [
        ("sacfd <cnn>", "100", "501"),
        ("sacfd <cnn>", "200", "1001"),
    ]
    text = (folder / "table.md").read_text()
    assert f"| {PICK} | sacfd equi | 2 | 10 | 0.900 | 0.596 to 1.000 |" in text
    assert "Some CPU, 2 cores, 2 threads; ba_torchrl 0.1.0, commit abc, torch 2.13.0" in text
    assert "it broke" in text
    # methods in alphabetical order: "sacfd <cnn>" first
    both = folder / "close_loop_4d.svg"
    assert {color: len(found) for color, found in lines(both).items()} == {BLUE: 2, ORANGE: 2}
    assert texts(both).count("sacfd <cnn>") == 2
    one = lines(folder / "close_loop_4d/close_loop_block_picking.svg")
    assert [len(found) for found in one.values()] == [1, 1]
    assert (folder / "close_loop_4d.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("seeds", [1, 4, 5])
def test_few_seeds_are_a_warning(tmp_path, seeds):
    for seed in range(seeds):
        write_run(tmp_path / f"runs/{seed}", (0.2, 0.7, 0.9), seed=seed)
    path = write([tmp_path / "runs"], tmp_path / "report")
    for name in ("report.html", "table.md"):
        text = (path.parent / name).read_text()
        assert ("Fewer than 5 seeds: direction only" in text) is (seeds < 5)
    figure = next((tmp_path / "report").glob("*.svg")).read_text()
    assert ("FillBetween" in figure) is (seeds != 4)  # the band of an interval


@pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
def test_the_table_sorts_and_filters(tmp_path):
    for rate, label in ((0.9, "sac cnn"), (0.1, "sac equi"), (1.0, "dagger cnn")):
        write_run(tmp_path / label, (0, 0, rate), label=label)
    write_run(tmp_path / "other", (0, 0, 0.5), task=PICK, label="sac cnn")
    path = write([tmp_path], tmp_path / "report")

    script = """
        const found = [], field = document.querySelector("input");
        const table = document.querySelector("th button").closest("table");
        const shown = () => found.push([...table.querySelectorAll("tbody tr:not([hidden])")].map(
            (row) => `${row.cells[4].textContent} ${row.cells[1].textContent}`));
        for (const column of [4, 4, 1, 8, 8]) {
            table.querySelectorAll("th button")[column].click();
            shown();
        }
        field.value = "CNN reach";
        field.dispatchEvent(new Event("input"));
        shown();
        document.documentElement.innerHTML = `<pre>${JSON.stringify(found)}</pre>`;
    """
    copy = path.with_name("copy.html")
    copy.write_text(path.read_text().replace("</body>", f"<script>{script}</script></body>"))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    command = ["chromium", *flags, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
    done = subprocess.run(
        [*command, copy.as_uri()], capture_output=True, text=True, check=True, timeout=120
    )
    rising, falling, methods, updates, updates_falling, filtered = json.loads(
        re.search("<pre>(.*)</pre>", done.stdout)[1]
    )
    assert rising == [
        "0.100 sac equi",
        "0.500 sac cnn",
        "0.700 sac cnn",
        "0.900 sac cnn",
        "1.000 dagger cnn",
    ]
    assert falling == rising[::-1]
    assert [row.split()[1] for row in methods] == ["dagger", "sac", "sac", "sac", "sac"]
    for rows in (updates, updates_falling):  # those that do not reach 80 % are last
        assert {*rows[:2]} == {"0.900 sac cnn", "1.000 dagger cnn"}
    assert {*filtered} == {"0.900 sac cnn", "1.000 dagger cnn"}


def test_panels_share_colours_and_keep_their_names(tmp_path):
    x = np.arange(500, 5000, 500)
    rising = 1 - np.exp(-x / 900)
    curves = {
        "a": {"first": Learning((x, rising)), "second": Learning((x, 0.5 * rising))},
        "b": {"second": Learning((x, rising))},
    }
    path = tmp_path / "p.svg"
    plot_panels(curves, [path, tmp_path / "p.pdf"], names=["first", "second"])
    pdf = (tmp_path / "p.pdf").read_bytes()
    assert b"/TrueType" in pdf or b"/CIDFontType2" in pdf
    assert b"/Type3" not in pdf
    found = lines(path)
    assert {color: len(curves) for color, curves in found.items()} == {BLUE: 1, ORANGE: 2}
    width = float(re.search(r'viewBox="0 0 ([\d.]+)', path.read_text())[1])
    assert [each[0, 0] > width / 2 for each in found[BLUE] + found[ORANGE]] == [False, False, True]
    first, _ = found[ORANGE][0][:, 0], found[ORANGE][1]  # x of 500 to 4500
    ticks = re.findall(
        r'<use xlink:href="#\w+" x="([\d.]+)" y="[\d.]+" style="stroke: #000', path.read_text()
    )
    assert float(ticks[0]) == pytest.approx(first[0] - (first[1] - first[0]), abs=0.5)  # at 0
    assert texts(path).count("first") == 1
    assert texts(path).count("second") == 2
    again = tmp_path / "again"
    plot_panels(curves, [again / "p.svg"], names=["first", "second"])
    assert (again / "p.svg").read_bytes() == path.read_bytes()
    plot_panels(curves, [path], names=["first", "second"], columns=1)
    above, below = lines(path)[ORANGE]
    assert above[0, 0] == pytest.approx(below[0, 0])
    assert above[:, 1].max() < below[:, 1].min()
    with pytest.raises(ValueError, match="third"):
        plot_panels({"a": {"third": Learning((x, x))}}, [path], names=["first"])


def test_the_command_reports_several_folders(tmp_path, capsys):
    for name in ("one", "two"):
        write_run(tmp_path / name / "run", (0.2, 0.7, 0.9), benchmark=name)
    folders = (f"{tmp_path}/one", f"{tmp_path}/two", f"folder={tmp_path}/out")
    recipe("report", *folders, "axis=updates")
    out = capsys.readouterr().out
    assert "## one" in out
    assert f"{tmp_path}/out/report.html" in out
    assert f"{tmp_path}/out/*.pdf" in out
    assert "updates" in texts(tmp_path / "out/one.svg")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    tables = {"table.csv", "table.md"}
    tables |= {"comparisons.csv", "seeds.csv", "curves.csv"}
    figures = {"one", "one.svg", "one.pdf", "two", "two.svg", "two.pdf"}
    assert names == {"report.html", *tables, *figures}


@pytest.mark.parametrize("count", [2, 8, 30])
def test_labels_are_apart_and_within_the_picture(tmp_path, count):
    names = [f"an algorithm on its network {i}" for i in range(count)]
    x = np.arange(5)
    path = tmp_path / "p.png"
    plot_panels({"task": dict.fromkeys(names, Learning((x, x / 8), (), 1.0))}, [path], names=names)
    picture = imageio.imread(path)[..., :3] / 255
    for edge in (picture[:, :2], picture[:, -2:], picture[:2], picture[-2:]):
        assert (edge > 0.99).all()
    labels = (picture[:, int(0.75 * picture.shape[1]) :] < 0.5).all(-1).any(1)
    lines = np.flatnonzero(np.diff(labels.astype(int)) == 1)
    assert len(lines) >= 2 * count  # two lines each
    within, between = (np.diff(lines)[start : 2 * count - 1 : 2].mean() for start in (0, 1))
    assert between > within
