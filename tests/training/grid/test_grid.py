import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ba_torchrl import list_tasks
from ba_torchrl.config import parse
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import RunResult, read_result
from ba_torchrl.training import hydra_schema, jobs
from ba_torchrl.training.grid.jobs import run_all
from ba_torchrl.training.grid.plan import BenchmarkConfig, plan, status

ROOT = Path(__file__).parents[2]
REACH, PICK = "close_loop/block_reaching", "close_loop/block_picking"
PLACE = "open_loop/block_stacking"
PRESETS = {
    ("algorithm", "sac"): {"name": "sac", "demonstration_weight": 0.0, "replay": "uniform"},
    ("algorithm", "sacfd"): {"name": "sac", "demonstration_weight": 1.0},
    ("network", "cnn"): {"name": "cnn"},
    ("network", "small"): {"name": "cnn", "width": 0.25},
}
COMMON = {
    "env": {"obs_size": 64, "max_steps": 8},
    "algorithm": {"batch_size": 8},
    "network": {},
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 2,
    "min_replay": 5,
    "total_updates": 6,
    "eval_every": 2,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "video_episodes": 0,
}


def preset(group, name):
    if (group, name) not in PRESETS:
        raise ConfigError(f"unknown {group} {name!r}. Known: sac, sacfd, cnn, small")
    return PRESETS[group, name]


def grid(tmp_path, **changes):
    values = {
        "name": "little",
        "folder": str(tmp_path / "grid"),
        "tasks": [REACH],
        "algorithms": ["sac"],
        "networks": ["small"],
        "seeds": 2,
    }
    return parse(BenchmarkConfig, {**values, **changes}, "benchmark")


def planned(tmp_path, common=(), **changes):
    return plan(grid(tmp_path, **changes), {**COMMON, **dict(common)}, preset)


# -- the grid ----------------------------------------------------------------------------------


def test_a_grid_is_the_product_of_its_axes_seed_by_seed(tmp_path):
    runs = planned(
        tmp_path, tasks=[REACH, PICK], algorithms=["sac", "sacfd"], networks=["cnn", "small"]
    )
    assert len(runs) == len({run.run_dir for run in runs}) == 16
    assert [run.seed for run in runs] == [0] * 8 + [1] * 8
    assert {run.task for run in runs[:8]} == {REACH, PICK}
    assert {run.label for run in runs[:8]} == {"sac cnn", "sac small", "sacfd cnn", "sacfd small"}
    first = runs[0]
    assert (first.task, first.label, first.seed) == (REACH, "sac cnn", 0)
    assert (first.benchmark, first.resume, first.total_updates) == ("little", True, 6)
    assert first.algorithm_config.replay == "uniform"
    assert first.algorithm_config.batch_size == 8
    assert first.run_dir.endswith("grid/close_loop_block_reaching/sac_cnn/seed0")
    assert [run.seed for run in planned(tmp_path, seeds=[7, 3])] == [7, 3]


def test_overrides_go_from_the_common_to_the_special(tmp_path):
    runs = planned(
        tmp_path,
        tasks=[REACH, PICK],
        algorithms=["sac", "sacfd"],
        networks=["cnn", "small"],
        seeds=1,
        per_task={PICK: {"demonstrations": 3, "env": {"max_steps": 9}, "min_replay": 11}},
        per_algorithm={"sacfd": {"algorithm": {"gamma": 0.9}, "demonstrations": 4}},
        per_network={"small": {"network": {"width": 0.5}, "demonstrations": 5}},
        common={"network": {"depth_scale_m": 0.1}},
    )
    by = {(run.task, run.label): run for run in runs}
    demonstrations = {key: run.demonstrations for key, run in by.items()}
    assert demonstrations[REACH, "sac cnn"] == 2
    assert demonstrations[PICK, "sac cnn"] == 3
    assert demonstrations[PICK, "sacfd cnn"] == 4
    assert demonstrations[PICK, "sacfd small"] == 5
    pick = by[PICK, "sacfd small"]
    assert pick.env == {"obs_size": 64, "max_steps": 9}
    assert by[REACH, "sacfd small"].env == {"obs_size": 64, "max_steps": 8}
    assert (pick.algorithm_config.gamma, pick.algorithm_config.batch_size) == (0.9, 8)
    assert by[PICK, "sac small"].algorithm_config.gamma == 0.99
    assert (pick.network_config.width, pick.network_config.depth_scale_m) == (0.5, 0.1)
    assert by[PICK, "sac cnn"].network_config.width == 1.0
    assert PRESETS["network", "small"] == {"name": "cnn", "width": 0.25}


def test_what_is_skipped_is_not_in_the_grid(tmp_path):
    runs = planned(
        tmp_path,
        tasks=[REACH, PICK],
        algorithms=["sac", "sacfd"],
        networks=["cnn", "small"],
        seeds=1,
        skip=[{"algorithm": "sac", "network": ["cnn"]}, {"task": PICK, "algorithm": "sacfd"}],
    )
    assert {(run.task, run.label) for run in runs} == {
        (REACH, "sac small"),
        (REACH, "sacfd cnn"),
        (REACH, "sacfd small"),
        (PICK, "sac small"),
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": [REACH, "close_loop/flying"]}, "Known: .*block_picking"),
        ({"algorithms": ["sac", "ppo"]}, "unknown algorithm 'ppo'.*sacfd"),
        ({"networks": ["mlp"]}, "unknown network 'mlp'.*small"),
        ({"per_task": {"close_loop/flying": {}}}, "Known: .*block_picking"),
        ({"per_network": {"smal": {}}}, "unknown network 'smal'"),
        ({"skip": [{"algorithm": ["sac", "ddpg"]}]}, "unknown algorithm 'ddpg'"),
        ({"skip": [{"robot": "kuka"}]}, "unknown axis 'robot'.*task, algorithm, network"),
        ({"skip": [{"task": REACH}]}, "grid is empty"),
        ({"tasks": []}, "tasks"),
        ({"seeds": 0}, "seeds"),
        ({"seeds": [1, 1]}, "names one twice"),
        ({"networks": ["cnn", "cnn"]}, "names one twice"),
        ({"sedes": 3}, "Did you mean 'seeds'"),
        ({"common": {"total_update": 5}}, "Did you mean 'total_updates'"),
        ({"common": {"seed": 5}}, "seed: set by the benchmark"),
        ({"common": {"network": {"widht": 1.0}}}, "with sac small: .*Did you mean 'width'"),
        ({"common": {"env": {"in_hand_size": 30}}}, f"{REACH}.*: 'in_hand_size' is for open-loop"),
        ({"common": {"env": {"robot": "sawyer"}}}, "kuka"),
        ({"tasks": [PLACE]}, "'sac' learns close_loop tasks"),
        ({"per_task": {REACH: {"env": {"obs_sise": 64}}}}, "Did you mean 'obs_size'"),
    ],
)
def test_wrong_grids_fail_before_anything_starts(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        planned(tmp_path, **changes)
    assert not (tmp_path / "grid").exists()


# -- the configurations that ship --------------------------------------------------------------


def shipped(name, *overrides):
    hydra_schema.register()
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        settings = compose(
            "benchmark", overrides=[f"benchmark={name}", *overrides], return_hydra_config=True
        )
        HydraConfig.instance().set_config(settings)
        own = OmegaConf.masked_copy(settings, [key for key in settings if key != "hydra"])
        values = OmegaConf.to_container(own, resolve=True)
        assert values.pop("dry_run") is False
        known = [name for name in BenchmarkConfig.model_fields if name in values]
        config = parse(BenchmarkConfig, {name: values.pop(name) for name in known}, "benchmark")
        return config, values, plan(config, values, hydra_schema.preset)


@pytest.mark.parametrize(
    ("name", "actions", "turned"),
    [("close_loop_3d", "pxyz", False), ("close_loop_4d", "pxyzr", True)],
)
def test_close_loop_benchmarks_are_the_papers(name, actions, turned):
    config, _, runs = shipped(name)
    assert sorted(config.tasks) == [task for task in list_tasks() if task.startswith("close_loop/")]
    assert len(runs) == 10 * 2 * 2 * 4
    assert {run.benchmark for run in runs} == {name}
    assert {run.run_dir.split("/")[1] for run in runs} == {name}
    for run in runs:
        env, algorithm = run.env_config, run.algorithm_config
        assert (env.action_sequence, env.random_orientation) == (actions, turned)
        assert (env.robot, env.obs_size, run.num_envs) == ("kuka", 128, 5)
        assert (run.demonstrations, run.total_updates) == (100, 10_000)
        assert (run.eval_every, run.eval_episodes) == (500, 100)
        assert (algorithm.learning_rate, algorithm.gamma) == (1e-3, 0.99)
        assert (algorithm.batch_size, algorithm.buffer_size) == (64, 100_000)
        assert (algorithm.alpha_init, algorithm.target_entropy) == (0.01, -5.0)
        assert (algorithm.replay == "prioritized") is run.label.startswith("sacfd")
    first = next(run for run in runs if run.label == "sacfd equi").algorithm_config
    assert (first.priority_exponent, first.importance_exponent, first.expert_bonus) == (
        0.6,
        0.4,
        1.0,
    )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("networks=[fcn,asr]", "sdqfd asr: .*no rz"),
        ("env.obs_size=90", "multiple of 16"),
        ("algorithm.augmentation=d4", "no yaw to turn"),
    ],
)
def test_networks_that_do_not_fit_are_refused_before_anything_starts(override, message):
    with pytest.raises(ConfigError, match=f"(?s){PLACE} with .*{message}"):
        shipped("open_loop_2d", f"tasks=[{PLACE}]", "network.width=0.1", override)


def test_small_budgets_are_a_matter_of_overrides():
    _, _, runs = shipped(
        "close_loop_4d",
        f"tasks=[{REACH}]",
        "algorithms=[sacfd]",
        "networks=[cnn,equi]",
        "seeds=1",
        "total_updates=600",
        "env.obs_size=64",
        "network.depth_scale_m=0.1",
        "algorithm.tau=0.05",
        "per_network.cnn.network.width=0.5",
        "folder=somewhere",
    )
    cnn, equi = runs
    assert (cnn.total_updates, cnn.env_config.obs_size) == (600, 64)
    assert cnn.network_config.width == 0.5
    assert {run.network_config.depth_scale_m for run in runs} == {0.1}
    assert {run.algorithm_config.tau for run in runs} == {0.05}
    assert equi.network["name"] == "equi"
    assert cnn.run_dir.startswith("somewhere/")


def test_unknown_presets_are_answered_with_those_there_are():
    with pytest.raises(ConfigError, match=r"unknown network 'resnet'.* Known: .*cnn.*equi"):
        shipped("close_loop_4d", "networks=[resnet]")
    with pytest.raises(ConfigError, match=r"unknown algorithm 'sacdf'\. Did you mean 'sacfd'"):
        shipped("close_loop_4d", "algorithms=[sacdf]")


@pytest.mark.parametrize("name", ["open_loop_2d", "open_loop_3d"])
def test_open_loop_benchmarks_are_the_papers(name):
    config, common, runs = shipped(name, "network.width=0.1")  # planning builds each network
    known = {task for task in list_tasks() if task.startswith("open_loop/")}
    left_out = {"open_loop/box_palletizing"} if name == "open_loop_2d" else set()
    assert set(config.tasks) == known - left_out
    assert config.seed_list() == [0, 1, 2, 3]
    assert common["env"]["action_sequence"] == {"2": "pxy", "3": "pxyr"}[name[-2]]
    assert common["env"]["random_orientation"] is (name == "open_loop_3d")
    assert (common["env"]["obs_size"], common["env"]["in_hand_size"]) == (128, 24)
    assert (common["demonstrations"], common["num_envs"]) == (200, 5)
    assert (common["total_updates"], common["eval_every"]) == (20_000, 500)
    assert {run.algorithm_config.gamma for run in runs} == {0.95}
    if name == "open_loop_3d":
        assert len(runs) == 12 * (5 + 3) * 4
        assert {run.env_config.obs_size for run in runs if "rot_fcn" in run.label} == {90}
        assert config.per_network["rot_fcn"] == {"env": {"obs_size": 90}}
        assert config.skips(task=PICK, algorithm="dqn", network="fcn")
        assert not config.skips(task=PICK, algorithm="dqn", network="equi_asr")
        assert not config.skips(task=PICK, algorithm="sdqfd", network="fcn")


# -- running it --------------------------------------------------------------------------------

FAKE_WORKER = """
import json, os, pathlib, signal, sys, time
config = json.load(sys.stdin)
folder = pathlib.Path(config["run_dir"])
(folder / "calls").open("a").write("x")
print("seed", config["seed"], "at work", flush=True)
orders = folder.parents[2] / f"orders-{config['seed']}"
order = orders.read_text() if orders.exists() else "finish"
if order == "fail":
    sys.exit("it broke")
if order == "die":
    os.kill(os.getpid(), signal.SIGSEGV)
if order == "hang":
    time.sleep(100)
if order == "meet":  # needs another one at the same time
    for _ in range(200):
        if len(list(folder.parent.glob("*/calls"))) == 2:
            break
        time.sleep(0.05)
    else:
        sys.exit("nobody came")
results = json.loads((folder.parents[2] / "results.json").read_text())
(folder / "result.json").write_text(results[config["run_dir"]])
"""


def result_of(run):
    return RunResult(
        task=run.task,
        label=run.label,
        benchmark=run.benchmark,
        seed=run.seed,
        curve=[],
        final={
            "policy": "last",
            "updates": 6,
            "episodes": 2,
            "success_rate": 0.5,
            "standard_error": 0.35,
            "mean_length": 3.0,
        },
        config=run.resolved(),
        versions={},
        hardware={},
        seconds=1.0,
        finished="2000-01-01T00:00:00+00:00",
        files={},
    )


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Return what runs a grid with a worker that obeys orders."""
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


def test_a_failure_is_recorded_and_stops_nothing_and_a_second_call_does_the_rest(tmp_path, fake):
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
    assert record["log"] == ["seed 1 at work", "it broke"]
    assert fake(runs) == {}
    assert [calls(run) for run in runs] == [1, 2, 2, 1]
    assert {status(run).state for run in runs} == {"done"}
    assert not (runs[1].folder / "failure.json").exists()


def test_a_run_beyond_its_time_is_stopped(tmp_path, fake):
    runs = planned(tmp_path)
    started = time.monotonic()
    failures = fake(runs, {0: "hang"}, max_hours=1 / 3600)
    assert time.monotonic() - started < 20
    assert failures == {runs[0].folder: "took longer than max_hours"}
    assert status(runs[1]).state == "done"


def test_jobs_run_at_the_same_time(tmp_path, fake):
    runs = planned(tmp_path)
    assert fake(runs, {0: "meet", 1: "meet"}, jobs=2) == {}


def test_an_interruption_ends_the_runs_under_way(tmp_path, fake, monkeypatch):
    runs = planned(tmp_path)
    processes = []
    start = subprocess.Popen

    def remember(*args, **kwargs):
        processes.append(start(*args, **kwargs))
        return processes[-1]

    def interrupt(seconds):
        if calls(runs[0]):
            raise KeyboardInterrupt

    monkeypatch.setattr(jobs.subprocess, "Popen", remember)
    monkeypatch.setattr(jobs.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fake(runs, {0: "hang"})
    assert [process.returncode for process in processes] == [-signal.SIGKILL]
    assert status(runs[0]).state == "missing"


def test_a_folder_with_other_settings_is_refused_before_anything_starts(tmp_path, fake):
    fake(planned(tmp_path, seeds=1))
    changed = planned(tmp_path, seeds=2, common={"total_updates": 8})
    with pytest.raises(ConfigError, match="total_updates: 6 there, 8 now"):
        fake(changed)
    assert calls(changed[1]) == 0


def test_a_run_that_somebody_else_is_at_is_left_alone(tmp_path, fake):
    runs = planned(tmp_path)
    runs[1].folder.mkdir(parents=True)
    with (runs[1].folder / "run.log").open("a") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match=r"another process is at .*seed1"):
            fake(runs)
    assert calls(runs[1]) == 0
    assert fake(runs) == {}
    assert (calls(runs[0]), calls(runs[1])) == (1, 1)


def test_a_killed_run_is_resumed_in_a_process_of_its_own(tmp_path):
    (run,) = planned(tmp_path, seeds=[5], common={"total_updates": 90, "eval_every": 15})
    state = run.folder / "resume"
    pids = []

    def kill_after_an_evaluation():
        for _ in range(6000):
            if any(not path.name.startswith(".") for path in state.glob("*")):
                pids.extend(children_of(os.getpid()))
                for pid in pids:
                    os.kill(pid, signal.SIGKILL)
                return
            time.sleep(0.005)

    killer = threading.Thread(target=kill_after_an_evaluation)
    killer.start()
    failures = run_all([run], progress=False)
    killer.join()
    assert len(pids) == 1
    assert failures == {run.folder: "killed by SIGKILL"}
    assert status(run).state == "failed"
    (run.folder / "failure.json").unlink()
    found = status(run)
    assert found.state == "interrupted"
    updates = int(found.detail.split()[4])
    assert run_all([run], progress=False) == {}
    result = read_result(run.folder)
    assert result.resumed_at == [updates]
    assert [point.updates for point in result.curve] == list(range(15, 91, 15))
    assert not state.exists()


def children_of(pid):
    """Return the processes that this one started to run benchmarks."""
    found = []
    for path in Path("/proc").glob("[0-9]*/status"):
        try:
            parent = path.read_text().split("PPid:\t")[1].split("\n")[0]
            command = (path.parent / "cmdline").read_text()
        except OSError:  # it ended meanwhile
            continue
        if int(parent) == pid and "ba_torchrl.training.grid.run_one" in command:
            found.append(int(path.parent.name))
    return found


def test_the_recipe_from_the_command_line(tmp_path):
    def recipe(*arguments, code=0):
        command = [sys.executable, "recipes/benchmark.py", *arguments]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
        assert done.returncode == code, done.stderr[-3000:]
        return done.stdout + done.stderr

    small = [f"{name}={value}" for name, value in COMMON.items() if not isinstance(value, dict)]
    arguments = (
        *small,
        f"tasks=[{REACH}]",
        "algorithms=[sacfd]",
        "networks=[cnn]",
        "seeds=2",
        "env.obs_size=64",
        "env.max_steps=8",
        "algorithm.batch_size=8",
        "network.width=0.25",
        f"folder={tmp_path}/grid",
    )
    # a run that cannot start, since its folder is taken by a file
    (tmp_path / "grid/close_loop_block_reaching/sacfd_cnn/seed0").mkdir(parents=True)
    blocked = tmp_path / "grid/close_loop_block_reaching/sacfd_cnn/seed0/checkpoints"
    blocked.write_text("in the way")
    out = recipe(*arguments, code=1)
    assert "1 of 2 runs done" in out
    assert "failed  " in out
    out = recipe(*arguments, "dry_run=true")
    assert "2 runs: 1 failed, 1 done" in out
    page = write_report([tmp_path / "grid"], tmp_path / "report").read_text()
    assert "close_loop_4d" in page
    assert "sacfd cnn" in page
