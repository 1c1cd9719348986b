import csv
import html
import re
import statistics
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ba_torchrl.record.plots import plot_panels
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import RunResult, differences, read_result, versions, write_result
from ba_torchrl.record.summary import interval, load_sections, standard_error, summarize

imageio = pytest.importorskip("imageio.v3")

ROOT = Path(__file__).parents[2]
REACH, PICK = "close_loop/block_reaching", "close_loop/block_picking"
UPDATES = (100, 200, 300)
BLUE, ORANGE = (0, 114, 178), (213, 94, 0)


def write_run(folder, rates, *, seed=0, final=None, task=REACH, label="sacfd equi", **changes):
    """Write the files of a finished run; ``rates`` are the success rates of the curve."""
    folder.mkdir(parents=True)
    config = {"task": task, "seed": seed, "env": {"obs_size": 64}, "run_dir": str(folder)}
    config |= changes.pop("config", {})
    values = {
        "task": task,
        "label": label,
        "benchmark": "close_loop_4d",
        "seed": seed,
        "curve": [
            {
                "updates": updates,
                "env_steps": 5 * updates + seed,
                "seconds": float(updates),
                "episodes": 10,
                "success_rate": rate,
                "standard_error": 0.1,
                "mean_length": 7.0,
            }
            for updates, rate in zip(UPDATES, rates, strict=False)
        ],
        "final": {
            "policy": "last",
            "updates": 300,
            "episodes": 10,
            "success_rate": rates[-1] if final is None else final,
            "standard_error": 0.1,
            "mean_length": 6.0 + seed,
        },
        "config": config,
        "versions": {"torch": "2.13.0", "ba_torchrl": "0.1.0"},
        "hardware": {"cpu": "Some CPU", "cores": 2, "memory_gb": 8.0, "gpu": None, "threads": 2},
        "seconds": 1800.0 + 360 * seed,
        "finished": "2000-01-01T00:00:00+00:00",
        "files": {},
    }
    write_result(folder, RunResult(**{**values, **changes}))
    return folder


def test_versions_name_the_commit_in_a_clone():
    command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode or not (ROOT / ".git").exists():
        pytest.skip("this is no clone")
    assert found.stdout.startswith(versions()["commit"].rstrip("+"))


def test_figures_over_seeds(tmp_path):
    curves = {0: (0.1, 0.8, 0.9), 1: (0.3, 0.9, 1.0), 2: (0.2, 0.6, 0.7)}
    for seed, rates in curves.items():
        write_run(tmp_path / f"seed{seed}", rates, seed=seed)
    (section,), unfinished = load_sections([tmp_path])
    assert unfinished == []
    (row,) = summarize(section)
    final = [0.9, 1.0, 0.7]
    assert (row["task"], row["method"], row["seeds"]) == (REACH, "sacfd equi", 3)
    assert row["success"] == pytest.approx(statistics.mean(final))
    assert row["standard_error"] == pytest.approx(statistics.stdev(final) / 3**0.5)
    assert row["curve_mean"] == pytest.approx(statistics.mean(sum(curves.values(), ())))
    # the mean curve is 0.2, 0.77, 0.87: at the last point it is beyond 0.8 for the first time
    assert row["updates_to_80"] == 300
    assert row["env_steps_to_80"] == pytest.approx(1501)
    assert row["mean_length"] == pytest.approx(7.0)
    assert row["hours"] == pytest.approx(0.6)
    assert 0.7 - 1e-9 <= row["low"] < row["success"] < row["high"] <= 1.0 + 1e-9


def test_standard_error_and_interval_against_plain_arithmetic():
    values = np.array([[0.0, 0.5], [1.0, 0.5]])
    assert standard_error(values).tolist() == [0.5, 0.0]
    assert np.isnan(standard_error(values[:1])).all()
    assert np.isnan(interval(np.array([0.3]))).all()
    # of two values the mean of a resample is one of them or half-way, 1:2:1
    assert interval(np.array([0.0, 1.0])) == (0.0, 1.0)
    assert interval(np.array([0.4, 0.4])) == (0.4, 0.4)
    many = np.random.default_rng(0).normal(2.0, 1.0, 400)
    low, high = interval(many)
    assert high - low == pytest.approx(2 * 1.96 * many.std(ddof=1) / 20, rel=0.1)


def test_a_rate_that_is_never_reached_gives_nan(tmp_path):
    write_run(tmp_path / "a", (0.1, 0.2, 0.3))
    (section,), _ = load_sections([tmp_path])
    assert np.isnan(summarize(section)[0]["updates_to_80"])


def test_the_last_point_of_a_run_that_ended_early_stands_for_later_ones(tmp_path):
    for seed, rates in enumerate([(0.1, 0.5, 0.7), (0.9, 0.9)]):
        write_run(tmp_path / f"seed{seed}", rates, seed=seed)
    (section,), _ = load_sections([tmp_path])
    (group,) = section.groups
    assert group.updates.tolist() == list(UPDATES)
    assert group.rates.tolist() == [[0.1, 0.5, 0.7], [0.9, 0.9, 0.9]]
    # the mean is 0.8 at the last point, where the seeds have 1500 and 1001 steps
    assert group.reaches(0.8) == (300.0, 1250.5)


def test_the_row_of_all_tasks_has_methods_that_ran_on_all_of_them(tmp_path):
    for seed, (limits, pick) in enumerate([(1.0, 0.5), (0.8, 0.1)]):
        rates = (0.0, 0.0)
        write_run(tmp_path / f"reach{seed}", (*rates, limits), seed=seed)
        write_run(tmp_path / f"pick{seed}", (*rates, pick), seed=seed, task=PICK)
    write_run(tmp_path / "other", (0.0, 0.0, 0.0), label="sac cnn")
    (section,), _ = load_sections([tmp_path])
    rows = summarize(section)
    assert [(row["task"], row["method"]) for row in rows] == [
        (PICK, "sacfd equi"),
        (REACH, "sac cnn"),
        (REACH, "sacfd equi"),
        ("all tasks", "sacfd equi"),
    ]
    together = rows[-1]
    # 0.75 and 0.45 by seed
    assert together["success"] == pytest.approx(0.6)
    assert together["standard_error"] == pytest.approx(0.15)
    assert together["seeds"] == 2


def test_runs_with_other_settings_are_not_averaged(tmp_path):
    write_run(tmp_path / "a", (0, 0, 0), seed=0)
    write_run(tmp_path / "b", (0, 0, 0), seed=1)
    write_run(tmp_path / "c", (1, 1, 1), seed=0, config={"env": {"obs_size": 128}})
    write_run(tmp_path / "d", (0, 0, 0), seed=2, config={"threads": 4, "device": "cuda"})
    (section,), _ = load_sections([tmp_path])
    found = {group.method: [run.result.seed for run in group.runs] for group in section.groups}
    assert found == {
        "sacfd equi (env.obs_size 64)": [0, 1, 2],
        "sacfd equi (env.obs_size 128)": [0],
    }


def test_benchmarks_have_sections_and_other_runs_are_last(tmp_path):
    for name in (None, "close_loop_4d", "close_loop_3d"):
        write_run(tmp_path / str(name), (0, 0, 1), benchmark=name)
    sections, _ = load_sections([tmp_path])
    assert [section.title for section in sections] == ["close_loop_3d", "close_loop_4d", "runs"]


def test_two_runs_of_one_seed_are_refused(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, (0, 0, 1))
    with pytest.raises(ValueError, match=r"settings and seed: .*/a, .*/b"):
        load_sections([tmp_path])


def test_folders_without_results_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no finished run below .*result\.json"):
        load_sections([tmp_path])
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        load_sections([tmp_path / "nowhere"])
    (tmp_path / "result.json").write_text('{"format": 2}')
    with pytest.raises(FileNotFoundError, match="no finished run"):  # none that can be read
        load_sections([tmp_path])


def test_a_result_is_read_as_it_was_written(tmp_path):
    folder = write_run(tmp_path / "a", (0.25, 0.5, 1.0), seed=3)
    result = read_result(folder)
    assert [point.success_rate for point in result.curve] == [0.25, 0.5, 1.0]
    assert result.final.mean_length == 9.0
    assert [path.name for path in folder.iterdir()] == ["result.json"]


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
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1].append(data)


def test_a_report_has_curves_tables_and_a_page(tmp_path):
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

    path = write_report([runs], tmp_path / "report")
    page = Page(path)
    assert page.open == []
    (picture,) = (source for source in page.sources if source.startswith("data:image/png;base64,"))
    assert len(picture) > 10_000
    assert "../runs/equiblock_picking0/evaluation.mp4" in page.sources
    assert (path.parent / "../runs/equiblock_picking0/evaluation.mp4").exists()
    assert "../runs/equiblock_picking1/evaluation.mp4" not in page.sources
    assert 'href="../runs/equiblock_picking1/evaluation.mp4"' in page.text
    assert "each run's last policy" in html.unescape(page.text)
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page.text)
    assert "sacfd &lt;cnn&gt;" in page.text
    assert "it broke" in page.text
    assert "stopped: interrupted" in page.text
    rows = {(row[0], row[1]): row for row in page.rows[1:]}
    assert len(rows) == 6
    assert rows[REACH, "sacfd equi"][2:4] == ["2", "0.900 ± 0.000"]
    assert rows[REACH, "sacfd equi"][6] == "300"
    assert rows["all tasks", "sacfd equi"][3] == "0.900 ± 0.000"

    with (path.parent / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 6
    assert {float(row["success"]) for row in table} == {0.9, 0.4}
    text = (path.parent / "table.md").read_text()
    assert f"| {PICK} | sacfd equi | 2 | 0.900 ± 0.000 | 0.900 to 0.900 |" in text
    assert "Some CPU, 2 cores, 2 threads; ba_torchrl 0.1.0, torch 2.13.0" in text
    assert "it broke" in text

    image = imageio.imread(path.parent / "close_loop_4d.png")[..., :3].astype(int)
    # methods in alphabetical order: "sacfd <cnn>" first
    for color in (BLUE, ORANGE):
        shade = 0.2 * np.array(color) + 0.8 * 255
        assert (np.abs(image - color).max(-1) <= 12).sum() > 500
        assert (np.abs(image - shade).max(-1) <= 3).sum() > 1000


def test_one_seed_has_no_shading_and_the_report_states_it(tmp_path):
    write_run(tmp_path / "runs/a", (0.2, 0.7, 0.9))
    path = write_report([tmp_path / "runs"], tmp_path / "report")
    image = imageio.imread(path.parent / "close_loop_4d.png")[..., :3].astype(int)
    shade = 0.2 * np.array(BLUE) + 0.8 * 255
    assert (np.abs(image - BLUE).max(-1) <= 12).sum() > 500
    assert (np.abs(image - shade).max(-1) <= 3).sum() < 500
    for name in ("report.html", "table.md"):
        text = (path.parent / name).read_text()
        assert "neither shading nor interval" in text
        assert "±" in text
    assert "| 1 | 0.900 | – |" in (path.parent / "table.md").read_text()
    write_run(tmp_path / "runs/b", (0.2, 0.7, 0.9), seed=1)
    path = write_report([tmp_path / "runs"], tmp_path / "report")
    assert "neither shading" not in (path.parent / "table.md").read_text()


def test_panels_share_colours_and_keep_their_names(tmp_path):
    x = np.arange(0, 5000, 500)
    rising = 1 - np.exp(-x / 900)
    curves = {
        "a": {"first": (x, rising), "second": (x, 0.5 * rising)},
        "b": {"second": (x, rising)},
    }
    path = plot_panels(curves, tmp_path / "p.png", names=["first", "second"])
    image = imageio.imread(path)[..., :3].astype(int)
    middle = int(0.55 * image.shape[1])  # between the panels, right of the label
    above_legend = image[: int(0.8 * image.shape[0])]

    def count(part, color):
        return int((np.abs(part - color).max(-1) <= 12).sum())

    assert count(above_legend[:, :middle], BLUE) > 300
    assert count(above_legend[:, middle:], BLUE) == 0
    assert count(above_legend[:, middle:], ORANGE) > 300
    with pytest.raises(ValueError, match="no panel"):
        plot_panels({}, tmp_path / "p.png", names=[])
    with pytest.raises(ValueError, match="third"):
        plot_panels({"a": {"third": (x, x)}}, tmp_path / "p.png", names=["first"])


def test_the_recipe_reports_several_folders(tmp_path):
    for name in ("one", "two"):
        write_run(tmp_path / name / "run", (0.2, 0.7, 0.9), benchmark=name)
    command = [sys.executable, "recipes/report.py", f"{tmp_path}/one", f"{tmp_path}/two"]
    done = subprocess.run(
        [*command, f"folder={tmp_path}/out"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "## one" in done.stdout
    assert f"{tmp_path}/out/report.html" in done.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "one.png",
        "two.png",
        "report.html",
        "table.csv",
        "table.md",
    }


@pytest.mark.parametrize("count", [2, 5, 8, 13])
def test_long_legends_stay_within_the_picture(tmp_path, count):
    names = [f"an algorithm on its network {i}" for i in range(count)]
    x = np.arange(5)
    path = plot_panels({"task": dict.fromkeys(names, (x, x / 5))}, tmp_path / "p.png", names=names)
    picture = imageio.imread(path)[..., :3] / 255
    assert (picture[:, :2] > 0.99).all()
    assert (picture[:, -2:] > 0.99).all()
    assert (picture[-2:] > 0.99).all()
