"""The benchmarks in ``configs``."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ba_torchrl.commands import benchmark
from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.modules import EquivariantConfig
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import presets
from ba_torchrl.training.grid.plan import BenchmarkConfig, expand, plan
from tests.training.grid.grids import PLACE, REACH

pytestmark = pytest.mark.usefixtures("cached_presets")
ROOT = Path(__file__).parents[3]


def shipped(name, *overrides, make_runs=plan):
    arguments = benchmark.COMMAND.read([f"benchmark={name}", *overrides])
    with benchmark.COMMAND.composed(arguments) as settings:
        values = OmegaConf.to_container(settings, resolve=True)
        assert (values.pop("dry_run"), values.pop("only")) == (False, None)
        known = [name for name in BenchmarkConfig.model_fields if name in values]
        config = parse(BenchmarkConfig, {name: values.pop(name) for name in known}, "benchmark")
        return config, values, make_runs(config, values, presets.preset)


GRIDS = {
    "action_space": (1, 6),
    "architectures": (1, 5),
    "close_loop_3d": (10, 170),
    "close_loop_4d": (10, 170),
    "close_loop_small": (1, 13),
    "cpu_close_loop": (10, 39),
    "cpu_open_loop": (12, 12),
    "cpu_six_dof": (9, 9),
    "demonstrations": (1, 6),
    "equivariance": (1, 4),
    "equivariance_imitation": (2, 24),
    "flow": (5, 75),
    "imitation": (2, 12),
    "open_loop_2d": (12, 96),
    "open_loop_3d": (12, 96),
    "open_loop_6d": (9, 45),
    "six_dof": (1, 2),
    "units": (1, 4),
}
"""Numbers of tasks and of runs with one seed, by benchmark; without that of graded sets."""
NAMES = sorted({path.stem for path in (ROOT / "configs/benchmark").glob("*.yaml")} - {"offline"})


@pytest.mark.parametrize("name", NAMES)
def test_the_runs_of_a_shipped_benchmark_are_valid(name):
    config, _, runs = shipped(name, "seeds=1", make_runs=expand)
    tasks, count = GRIDS[name]
    assert len(config.tasks) == len({run.task for run in runs}) == tasks
    assert len(runs) == len({run.run_dir for run in runs}) == count
    assert {run.benchmark for run in runs} == {name}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_environments_and_networks_of_a_shipped_benchmark_can_be_built(name):
    shipped(name, "seeds=1")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("networks=[fcn,asr]", "sdqfd asr: .*no rz"),
        ("env.obs_size=90", "multiple of 16"),
        ("algorithm.rotation.name=d4", "no yaw to rotate"),
    ],
)
def test_networks_for_other_actions_or_images_are_refused(override, message):
    with pytest.raises(ConfigError, match=f"(?s){PLACE} with .*{message}"):
        shipped("open_loop_2d", f"tasks=[{PLACE}]", "network.width=0.1", override)


def test_overrides_make_a_small_budget():
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
    assert (cnn.total_updates, cnn.env.config.obs_size) == (600, 64)
    assert cnn.network.width == 0.5
    assert {run.network.depth_scale_m for run in runs} == {0.1}
    assert {run.algorithm.tau for run in runs} == {0.05}
    assert isinstance(equi.network, EquivariantConfig)
    assert cnn.run_dir.startswith("somewhere/")


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown network 'resnet'.* Known: .*cnn.*equi"):
        shipped("close_loop_4d", "networks=[resnet]")
    with pytest.raises(ConfigError, match=r"unknown algorithm 'sacdf'\. Did you mean 'sacfd'"):
        shipped("close_loop_4d", "algorithms=[sacdf]")


def test_offline_learning_reads_each_set_and_plays_no_episode(monkeypatch):
    monkeypatch.setattr(
        "ba_torchrl.demonstrations.demo_files.check_demonstrations", lambda *_, **__: None
    )
    config, _, runs = shipped("offline")
    methods = {"close_loop": {"bc cnn", "iql cnn"}, "open_loop": {"bc asr", "sdqfd asr"}}
    found = {(run.task, run.label) for run in runs}
    assert found == {
        (task, f"{method} {grade}")
        for task in config.tasks
        for method in methods[TASKS[task].control]
        for grade in ("random", "medium", "expert", "mixed")
    }
    assert len(found) == 64
    for run in runs:
        assert run.demonstrations_path == f"graded/{run.task}/{run.label.split()[-1]}"
        assert run.pretrain_updates == run.total_updates
        assert not run.only_successful_demonstrations
