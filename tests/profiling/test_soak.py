"""The soak test: figures of each task, which the same call does not measure again."""

import json
import sys

import pytest

from recipes.soak import TABLE_FILE, SoakFigures, SoakJob, run_soak

JOB = SoakJob(task="close_loop/block_reaching", steps=60, env={"obs_size": 16, "max_steps": 10})


@pytest.fixture
def figures():
    rates = {"expert_success": 1.0, "memory_mb": 200.0, "memory_growth": 0.0, "steps_per_s": 9.0}
    return SoakFigures(job=JOB, episodes=6, faults=0, clients_left=0, **rates)


def worker(folder, figures, code=""):
    """A command that notes its calls and prints the figures of its job."""
    script = folder / "worker.py"
    values = figures.model_dump(mode="json")
    script.write_text(
        "import json, sys\n"
        "job = json.load(sys.stdin)\n"
        f"print(job['task'], file=open({str(folder / 'calls')!r}, 'a'))\n"
        f"{code}\n"
        f"print(json.dumps({{**json.loads({json.dumps(values)!r}), 'job': job}}))\n"
    )
    return sys.executable, str(script)


def calls(folder):
    return (folder / "calls").read_text().split()


def test_complete_tasks_are_not_measured_again(tmp_path, figures):
    jobs = [JOB.model_copy(update={"task": f"mine/{name}"}) for name in ("a", "b")]
    fail = "if job['task'] == 'mine/b': sys.exit('no simulator today')"
    failures = run_soak(
        jobs, tmp_path / "soak", progress=False, worker=worker(tmp_path, figures, fail)
    )
    assert failures == {"mine/b": "exit code 1\nno simulator today"}
    good = worker(tmp_path, figures)
    assert run_soak(jobs, tmp_path / "soak", progress=False, worker=good) == {}
    assert calls(tmp_path) == ["mine/a", "mine/b", "mine/b"]
    table = (tmp_path / "soak" / TABLE_FILE).read_text()
    assert "| `mine/a` | 60 |" in table
    assert "| `mine/b` | 60 |" in table
    # other settings, and a damaged file, are measured again
    (tmp_path / "soak" / "mine-a.json").write_text("{")
    jobs[1] = jobs[1].model_copy(update={"steps": 70})
    assert run_soak(jobs, tmp_path / "soak", progress=False, worker=good) == {}
    assert calls(tmp_path)[3:] == ["mine/a", "mine/b"]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"faults": 2}, "2 faults"),
        ({"memory_growth": 0.03}, "memory grows"),
        ({"clients_left": 1}, "clients left"),
    ],
)
def test_criteria_that_are_not_met_are_reported(tmp_path, figures, change, problem):
    poor = SoakFigures.model_validate({**figures.model_dump(), **change})
    failures = run_soak([JOB], tmp_path / "s", progress=False, worker=worker(tmp_path, poor))
    assert failures == {JOB.task: problem}
