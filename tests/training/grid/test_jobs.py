"""Runs of a grid in separate processes: failures, interruptions, resumption."""

import functools
import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ba_torchrl.commands.benchmark import print_estimate
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import RunResult, read_result, write_result
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.checkpoint import lock_run
from ba_torchrl.training.grid import jobs
from ba_torchrl.training.grid.jobs import run_all
from ba_torchrl.training.grid.plan import Status, status
from tests.recipes import recipe
from tests.record.test_report import RESULT, policy_test, write
from tests.training.grid.grids import COMMON, REACH, planned
from tests.training.test_resume import interrupt

FAKE_WORKER = """
import json, os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
seed = folder.name.removeprefix("seed")
(folder / "calls").open("a").write("x")
print("seed", seed, "runs", flush=True)
orders = folder.parents[2] / f"orders-{seed}"
order = orders.read_text() if orders.exists() else "finish"
if order == "fail":
    sys.exit("it broke")
if order == "die":
    os.kill(os.getpid(), signal.SIGSEGV)
if order == "hang":
    time.sleep(1000)
if order == "save":  # until the third run starts
    signal.signal(signal.SIGTERM, lambda *_: (folder / "asked").touch())
    while not (folder / "asked").exists() or not (folder.parent / "seed2" / "calls").exists():
        time.sleep(0.05)
    (folder / "met").touch()
    sys.exit()
if order == "wait":  # until the first run saves
    while not (folder.parent / "seed0" / "asked").exists():
        time.sleep(0.05)
if order == "meet":  # needs another one at the same time
    for _ in range(2400):
        if len(list(folder.parent.glob("*/calls"))) == 2:
            break
        time.sleep(0.05)
    else:
        sys.exit("the other run did not start")
results = json.loads((folder.parents[2] / "results.json").read_text())
(folder / "result.json").write_text(results[str(folder)])
"""


def result_of(run):
    of_run = {name: getattr(run, name) for name in ("task", "label", "benchmark", "seed")}
    test = policy_test(0.5, episodes=2)
    own = {"curve": [], "last": test, "best": test, "config": run.resolved(), "seconds": 1.0}
    return RunResult(**{**RESULT, **of_run, **own})


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Return a function that runs a grid with a fake worker, whose behaviour is set by a file."""
    script = tmp_path / "worker.py"
    script.write_text(FAKE_WORKER)
    monkeypatch.setattr(jobs, "POLL_S", 0.02)

    def run(runs, orders=(), **options):
        grid = Path(runs[0].run_dir).parents[2]
        grid.mkdir(exist_ok=True)
        for path in grid.glob("orders-*"):
            path.unlink()
        for seed, order in dict(orders).items():
            (grid / f"orders-{seed}").write_text(order)
        results = {run.run_dir: result_of(run).model_dump_json() for run in runs}
        (grid / "results.json").write_text(json.dumps(results))
        return run_all(runs, progress=False, worker=[sys.executable, str(script)], **options)

    return run


def calls(run):
    path = run.folder / "calls"
    return len(path.read_text()) if path.exists() else 0


def test_a_failed_run_is_recorded_and_repeated_by_the_next_call(tmp_path, fake):
    runs = planned(tmp_path, seeds=4)
    assert {str(status(run)) for run in runs} == {"missing"}
    failures = fake(runs, {1: "fail", 2: "die"})
    assert failures == {
        runs[1].folder: "exit status 1: it broke",
        runs[2].folder: "killed by SIGSEGV",
    }
    assert [status(run).state for run in runs] == ["done", "failed", "failed", "done"]
    assert str(status(runs[0])) == "done: success 0.50"
    assert str(status(runs[1])) == "failed: exit status 1: it broke"
    record = json.loads((runs[1].folder / "failure.json").read_text())
    assert record["log"] == ["seed 1 runs", "it broke"]
    assert fake(runs) == {}
    assert [calls(run) for run in runs] == [1, 2, 2, 1]
    assert {status(run).state for run in runs} == {"done"}
    assert not (runs[1].folder / "failure.json").exists()


def test_a_setting_that_is_newer_than_a_finished_run_has_its_default_there(tmp_path, fake):
    run = planned(tmp_path)[0]
    fake([run])
    path = run.folder / "result.json"
    saved = json.loads(path.read_text())
    del saved["config"]["env"]["reward"]
    path.write_text(json.dumps(saved))
    assert status(run).state == "done"
    saved["config"]["env"]["reward"] = "dense"
    path.write_text(json.dumps(saved))
    assert status(run).state == "other"
    assert "env.reward: 'dense' there, 'sparse' now" in status(run).detail


@pytest.mark.parametrize("name", ["version", "expert_version"])
def test_a_finished_run_of_another_version_is_refused(tmp_path, fake, monkeypatch, name):
    run = planned(tmp_path)[0]
    fake([run])
    assert status(run).state == "done"
    monkeypatch.setattr(TASKS[run.task], name, 7)
    assert re.search(r"^other: .* here are .* version 7.*: choose another", str(status(run)))
    path = run.folder / "result.json"
    saved = json.loads(path.read_text())
    saved |= {"task_version": TASKS[run.task].version, "expert_version": None}
    path.write_text(json.dumps(saved))
    assert status(run).state == "done"  # no expert took part


def test_a_run_that_exceeds_its_time_limit_saves_its_state_and_blocks_no_other(tmp_path, fake):
    runs = planned(tmp_path, seeds=3)
    failures = fake(runs, {0: "save", 1: "wait"}, max_hours=8 / 3600, jobs=2)
    assert (runs[0].folder / "met").exists()
    assert failures[runs[0].folder] == "took longer than max_hours"
    assert status(runs[2]).state == "done"


def test_a_run_that_does_not_save_its_state_in_time_is_killed(tmp_path, fake, monkeypatch):
    monkeypatch.setattr(jobs, "SAVE_S", 0.1)
    runs = planned(tmp_path, seeds=1)
    assert fake(runs, {0: "save"}, max_hours=2 / 3600).keys() == {runs[0].folder}
    assert not (runs[0].folder / "met").exists()


def test_jobs_run_at_the_same_time(tmp_path, fake):
    runs = planned(tmp_path)
    assert fake(runs, {0: "meet", 1: "meet"}, jobs=2) == {}


def test_the_bar_shows_the_update_and_the_estimated_time_of_a_run(tmp_path, fake, monkeypatch):
    run = planned(tmp_path, seeds=1, common={"total_updates": 100})[0]
    rows = run.folder / "scalars.csv"
    seen, clock = [], iter(range(0, 10**6, 60))
    monkeypatch.setattr(jobs.time, "monotonic", lambda: next(clock))
    job = jobs._Job(run, [sys.executable, "-c", ""], None)
    for content in (None, "step,name,value\n", "step,name,value\n0,a,1\n", "25,b,2.0\n50,b,1"):
        if content is not None:
            rows.open("a").write(content)
        seen.append(job.progress())
    job.terminate()
    job._process.wait()
    name = f"{REACH} sac small seed 0"
    assert seen == [name, name, f"update 0/100: {name}", f"update 25/100, 03:00 left: {name}"]


def test_an_interruption_ends_the_running_jobs(tmp_path, fake, monkeypatch, capsys):
    runs = planned(tmp_path)
    processes, interrupted = [], []
    start = subprocess.Popen

    def remember(*args, **kwargs):
        processes.append(start(*args, **kwargs))
        return processes[-1]

    def interrupt(seconds):
        if calls(runs[0]) and not interrupted:
            interrupted.append(True)
            raise KeyboardInterrupt

    monkeypatch.setattr(jobs.subprocess, "Popen", remember)
    monkeypatch.setattr(jobs.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fake(runs, {0: "hang"})
    assert [process.returncode for process in processes] == [-signal.SIGTERM]
    assert status(runs[0]).state == "missing"
    assert "the present runs save their states" in capsys.readouterr().out


SLOW_TO_SAVE = """
import pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append(0))
(folder / "calls").write_text("x")
while not asked:
    time.sleep(0.05)
time.sleep(0.5 + 0.5 * (folder.name == "seed1"))
(folder / "asked").write_text(str(len(asked)))
"""


def test_an_interruption_asks_each_job_once_and_waits_for_all(tmp_path, monkeypatch):
    runs = planned(tmp_path)
    script = tmp_path / "worker.py"
    script.write_text(SLOW_TO_SAVE)

    sleep, interrupted = time.sleep, []

    def interrupt(seconds):
        if not interrupted and all((run.folder / "calls").exists() for run in runs):
            interrupted.append(True)
            raise KeyboardInterrupt
        sleep(seconds)

    monkeypatch.setattr(jobs.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_all(runs, jobs=2, progress=False, worker=[sys.executable, str(script)])
    assert [(run.folder / "asked").read_text() for run in runs] == ["1", "1"]


def test_a_folder_with_other_settings_is_refused_before_anything_starts(tmp_path, fake):
    fake(planned(tmp_path, seeds=1))
    changed = planned(tmp_path, seeds=2, common={"total_updates": 8})
    assert [status(run).state for run in changed] == ["other", "missing"]
    with pytest.raises(ConfigError, match="total_updates: 6 there, 8 now"):
        fake(changed)
    assert calls(changed[1]) == 0


@pytest.mark.parametrize("jobs_at_once", [1, 2])
def test_a_run_that_another_process_starts_meanwhile_is_left_to_it(
    jobs_at_once, tmp_path, fake, capsys, monkeypatch
):
    runs, sleep, locks = planned(tmp_path), time.sleep, []

    def start(seconds):
        locks.append(locks[0] if locks else lock_run(runs[1].folder))
        sleep(seconds)

    with monkeypatch.context() as patch:
        patch.setattr(jobs.time, "sleep", start)
        assert fake(runs, {1: "fail"}, jobs=jobs_at_once) == {}
    assert f"skipped: process {os.getpid()} on " in capsys.readouterr().out
    started = jobs_at_once - 1  # the second of two runs is under way when the lock is taken
    assert (calls(runs[0]), calls(runs[1])) == (1, started)
    locks[0].release()
    assert fake(runs) == {}
    assert (calls(runs[0]), calls(runs[1])) == (1, started + 1)


def test_a_run_that_still_works_is_skipped_by_the_name_of_its_process(tmp_path, fake, capsys):
    runs = planned(tmp_path)
    lock = lock_run(runs[0].folder)
    assert str(status(runs[0])).startswith(f"running: process {os.getpid()} on ")
    assert fake(runs) == {}
    assert f"skipped: process {os.getpid()} on " in capsys.readouterr().out
    assert (calls(runs[0]), calls(runs[1])) == (0, 1)
    lock.release()
    assert fake(runs) == {}
    assert status(runs[0]).state == "done"


@pytest.mark.parametrize(
    ("name", "state"),
    [("result.json", "unreadable"), ("failure.json", "failed"), ("config.json", "unreadable")],
)
def test_a_damaged_file_concerns_its_run_only(tmp_path, fake, name, state):
    runs = planned(tmp_path)
    fake(runs[1:])
    runs[0].folder.mkdir(parents=True)
    for content in (b"", b'{"task": "clo', b"\x80\x04\x95", b"[]", b"{}"):
        (runs[0].folder / name).write_bytes(content)
        assert [status(run).state for run in runs] == [state, "done"]
        assert name in status(runs[0]).detail
    page = write([tmp_path], tmp_path / "report")
    text = {"result.json": "result.json has no valid result", "failure.json": "is damaged"}
    assert text.get(name, "") in (page.parent / "table.md").read_text()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"algorithm": {"name": "theirs"}}, "unknown algorithm 'theirs'"),
        ({"algorithm": {"name": ["sac"]}}, "unknown algorithm ['sac']"),
        ({"plugins": ["antigravity"]}, "uses the plugins [antigravity]"),
        ({"new": 1}, "unknown parameter 'new'"),
        (None, "Not a directory"),  # a file has the name of the folder
    ],
)
def test_a_run_that_cannot_be_read_is_left_out_and_named(tmp_path, fake, capsys, changes, reason):
    first, other = planned(tmp_path)
    first.folder.parent.mkdir(parents=True)
    if changes is None:
        first.folder.touch()
    else:
        result = result_of(first)
        write_result(first.folder, result.model_copy(update={"config": result.config | changes}))
    failures = fake([first, other])
    assert [status(run).state for run in (first, other)] == ["unreadable", "done"]
    assert reason in failures[first.folder]
    assert f"; delete {first.folder} to start the run again" in failures[first.folder]
    assert f"left out: {failures[first.folder]}" in capsys.readouterr().out


@pytest.mark.slow
def test_a_killed_run_is_resumed_in_a_new_process(tmp_path):
    (run,) = planned(tmp_path, seeds=[5])
    interrupt(run, after=5)
    found = status(run)
    assert (found.state, found.detail.split()[3]) == ("interrupted", "4")
    assert run_all([run], progress=False) == {}
    result = read_result(run.folder)
    assert result.resumed_at == [4]
    assert [point.updates for point in result.curve] == [0, 2, 4, 6]
    assert not (run.folder / "resume").exists()


def test_a_run_ends_with_its_grid(tmp_path):
    """It would learn on, unseen, if the grid is killed or its terminal is closed."""
    config, open_end = os.pipe()  # which the run waits for
    ended, end = os.pipe()
    start = f"""
import os, subprocess
worker = {[*jobs.WORKER, "run"]} + [str(os.getpid())]
run = subprocess.Popen(worker, stdin={config}, pass_fds=[{end}])
print(run.pid, flush=True)
run.wait()
"""
    command = [sys.executable, "-c", start]
    with subprocess.Popen(command, pass_fds=[config, end], stdout=subprocess.PIPE) as grid:
        os.close(end)
        assert int(grid.stdout.readline())  # the run has started
        grid.kill()
    assert select.select([ended], [], [], 60)[0]  # its last holder has ended
    assert os.read(ended, 1) == b""
    for pipe in (config, open_end, ended):
        os.close(pipe)


@pytest.mark.usefixtures("cached_presets")
def test_the_recipe_runs_a_grid_in_processes_and_lists_it(tmp_path, capsys, monkeypatch):
    small = [f"{name}={value}" for name, value in COMMON.items() if not isinstance(value, dict)]
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the recipe's handler would stay

    def printed(*arguments):
        recipe(
            "benchmark",
            *small,
            f"tasks=[{REACH}]",
            "algorithms=[sacfd]",
            "networks=[cnn]",
            "env.obs_size=64",
            "env.max_steps=8",
            "algorithm.batch_size=8",
            "network.width=0.25",
            f"folder={tmp_path}/grid",
            *arguments,
        )
        return capsys.readouterr().out

    assert "1 of 1 runs done" in printed("seeds=1")
    breaking = [sys.executable, "-c", "raise SystemExit('it broke')"]
    monkeypatch.setattr(jobs, "run_all", functools.partial(run_all, worker=breaking))
    with pytest.raises(SystemExit) as end:
        printed("seeds=2")
    assert end.value.code == 1
    out = capsys.readouterr().out
    assert "1 of 2 runs done" in out
    assert "failed  " in out
    listed = printed("seeds=2", "dry_run=true")
    assert "2 runs: 1 done, 1 failed" in listed
    assert re.search(r"about \d+ min for 1 of 1 runs", listed)
    first, second = planned(tmp_path)
    long = [(first, Status("done", seconds=4950.0)), (second, Status("missing"))]
    print_estimate(long, 1)
    assert "about 1 h 23 min for 1 of 1 runs" in capsys.readouterr().out
    more = ("seeds=3", "dry_run=true", "jobs=2")
    assert "for 2 of 2 runs, 2 at a time" in printed(*more)
    assert "for 2 of 2 runs, 1 at a time" in printed(*more, "launcher=ray")  # jobs has no effect

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs, "run_all", interrupted)
    with pytest.raises(SystemExit):
        printed("seeds=2")
    assert "the same command continues the grid\n" in capsys.readouterr().err
    page = write([tmp_path / "grid"], tmp_path / "report").read_text()
    assert "close_loop_4d" in page
    assert "sacfd cnn" in page
