"""The benchmarks in ``configs`` have the values of the appendix or the reference."""

import math
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.grid.plan import BenchmarkConfig, plan
from tests.training.grid.grids import PICK, PLACE, REACH

pytestmark = pytest.mark.usefixtures("cached_presets")
ROOT = Path(__file__).parents[3]


CLOSE_LOOP_METHODS = {
    *(
        f"{algorithm} {net}"
        for algorithm in ("sac", "sacfd", "sacfd_per", "sacfd_per_so2")
        for net in ("cnn", "equi")
    ),
    *(f"{kind}_{base} cnn" for kind in ("rad", "drq") for base in ("sac", "sacfd", "sacfd_per")),
    *(f"ferm_{base} ferm" for base in ("sac", "sacfd", "sacfd_per")),
}
"""Labels of the methods of figures 20 and 22, and of the reference's replay with rotated copies."""
NEVER = 1_000_000
"""Attempts that no run reaches."""


def tasks_of(control):
    """Return the built-in tasks of a control."""
    built_in = (task for task in TASKS if TASKS.plugin_module(task) is None)
    return [task for task in built_in if TASKS[task].control == control]


def shipped(name, *overrides):
    hydra_schema.register()
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        settings = compose(
            "benchmark", overrides=[f"benchmark={name}", *overrides], return_hydra_config=True
        )
        HydraConfig.instance().set_config(settings)
        own = OmegaConf.masked_copy(settings, [key for key in settings if key != "hydra"])
        values = OmegaConf.to_container(own, resolve=True)
        assert (values.pop("dry_run"), values.pop("only")) == (False, None)
        known = [name for name in BenchmarkConfig.model_fields if name in values]
        config = parse(BenchmarkConfig, {name: values.pop(name) for name in known}, "benchmark")
        return config, values, plan(config, values, hydra_schema.preset)


@pytest.mark.parametrize(
    ("name", "actions", "turned"),
    [
        pytest.param("close_loop_3d", "pxyz", False, marks=pytest.mark.slow),
        ("close_loop_4d", "pxyzr", True),
    ],
)
def test_close_loop_benchmarks_have_the_appendix_or_reference_values(name, actions, turned):
    config, _, runs = shipped(name)
    assert sorted(config.tasks) == tasks_of("close_loop")
    methods = {run.label for run in runs}
    assert methods == CLOSE_LOOP_METHODS
    assert len(runs) == 10 * len(methods) * 4
    assert {run.benchmark for run in runs} == {name}
    assert {run.run_dir.split("/")[1] for run in runs} == {name}
    for run in runs:
        env, algorithm = run.resolved_env.config, run.algorithm_config
        assert (env.action_sequence, env.random_orientation) == (actions, turned)
        pretraining, size = (1600, 142) if "ferm" in run.label else (0, 128)
        assert (env.robot, env.obs_size, run.num_envs) == ("kuka", size, 5)
        low, high = np.transpose(env.workspace)
        assert high - low == pytest.approx([0.3, 0.3, 0.24])
        assert env.view_scale * 0.3 == pytest.approx(0.45)
        assert getattr(env, "max_attempts", NEVER) == NEVER
        assert run.network_config.precision == "float32"
        assert (run.demonstrations, run.pretrain_updates) == (100, pretraining)
        assert run.total_updates == 10_000 + pretraining
        assert (run.eval_every, run.eval_episodes) == (500, 100)
        assert (algorithm.learning_rate, algorithm.gamma) == (1e-3, 0.99)
        assert (algorithm.batch_size, algorithm.buffer_size) == (64, 100_000)
        assert (algorithm.alpha_init, algorithm.target_entropy) == (0.01, -5.0)
        assert algorithm.replay == ("prioritized" if "_per" in run.label else "uniform")
        assert (algorithm.priority_exponent, algorithm.importance_exponent) == (0.6, 0.4)
        assert algorithm.expert_bonus == 1.0
        rotation = ("so2", 4) if "_so2" in run.label else ("none", 0)
        assert (algorithm.augmentation, algorithm.stored_copies) == rotation
        assert (algorithm.demonstration_weight > 0) is ("sacfd" in run.label)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("networks=[fcn,asr]", "sdqfd asr: .*no rz"),
        ("env.obs_size=90", "multiple of 16"),
        ("algorithm.augmentation=d4", "no yaw to rotate"),
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
    assert (cnn.total_updates, cnn.resolved_env.config.obs_size) == (600, 64)
    assert cnn.network_config.width == 0.5
    assert {run.network_config.depth_scale_m for run in runs} == {0.1}
    assert {run.algorithm_config.tau for run in runs} == {0.05}
    assert equi.network["name"] == "equi"
    assert cnn.run_dir.startswith("somewhere/")


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown network 'resnet'.* Known: .*cnn.*equi"):
        shipped("close_loop_4d", "networks=[resnet]")
    with pytest.raises(ConfigError, match=r"unknown algorithm 'sacdf'\. Did you mean 'sacfd'"):
        shipped("close_loop_4d", "algorithms=[sacdf]")


def check_open_loop(run):
    """Assert that a run has the values of appendix G.1 that all open-loop benchmarks share."""
    env, algorithm = run.resolved_env.config, run.algorithm_config
    low, high = np.transpose(env.workspace)
    assert env.robot == "kuka"
    assert (high - low)[:2] == pytest.approx([0.4, 0.4])
    assert run.network_config.precision == "float32"
    assert run.only_successful_demonstrations
    assert (run.num_envs, run.eval_every) == (5, 500)
    assert (algorithm.learning_rate, algorithm.weight_decay) == (1e-4, 1e-5)
    assert (algorithm.gamma, algorithm.batch_size, algorithm.buffer_size) == (0.95, 16, 100_000)
    assert (algorithm.replay, algorithm.epsilon_init, algorithm.epsilon_end) == ("symmetric", 0, 0)
    if algorithm.demonstrations in ("sdqfd", "dqfd"):
        assert (algorithm.demonstration_weight, algorithm.margin) == (0.1, 0.1)


@pytest.mark.parametrize("name", ["open_loop_2d", "open_loop_3d"])
def test_open_loop_benchmarks_have_the_values_of_the_appendix_or_the_reference(name):
    config, common, runs = shipped(name, "network.width=0.1")  # planning builds each network
    known = {task for task in tasks_of("open_loop") if task.startswith("open_loop/")}
    assert set(config.tasks) == known
    assert config.seed_list() == [0, 1, 2, 3]
    assert common["env"]["action_sequence"] == {"2": "pxy", "3": "pxyr"}[name[-2]]
    assert common["env"]["random_orientation"] is (name == "open_loop_3d")
    assert (common["env"]["obs_size"], common["env"]["in_hand_size"]) == (128, 24)
    assert (common["demonstrations"], common["num_envs"]) == (200, 5)
    assert (common["total_updates"], common["eval_every"]) == (20_000, 500)
    assert config.algorithms == ["sdqfd", "dqfd", "adet", "dqn"]
    for run in runs:
        check_open_loop(run)
    own = {run.task: run.resolved_env.config for run in runs}
    is_turned = name == "open_loop_3d"
    assert own["open_loop/box_palletizing"].num_objects == (18 if is_turned else 6)
    assert own["open_loop/object_grasping"].max_attempts == (NEVER if is_turned else None)
    if not is_turned:
        assert len(runs) == 12 * 4 * 2 * 4
    else:
        assert len(runs) == 12 * (5 + 3) * 4
        assert {run.resolved_env.config.obs_size for run in runs if "rot_fcn" in run.label} == {90}
        assert config.per_network["rot_fcn"] == {"env": {"obs_size": 90}}
        equi = [run.network_config for run in runs if run.network["name"] == "equi_asr"]
        assert {network.scene_head for network in equi} == {"flatten"}
        assert config.skips(task=PICK, algorithm="dqn", network="fcn")
        assert not config.skips(task=PICK, algorithm="dqn", network="equi_asr")
        assert not config.skips(task=PICK, algorithm="sdqfd", network="fcn")


def test_the_benchmark_in_six_degrees_of_freedom_has_the_values_of_the_appendix_or_the_reference():
    config, common, runs = shipped("open_loop_6d", "network.width=0.1")
    ramps = [task for task in config.tasks if task.startswith("ramp/")]
    bumps = [task for task in config.tasks if task.startswith("bump/")]
    assert (len(ramps), len(bumps)) == (7, 2)
    assert set(config.tasks) <= set(TASKS)
    assert len(runs) == 9 * (2 + 3) * 4
    assert (common["total_updates"], common["eval_every"], common["num_envs"]) == (20_000, 500, 5)
    for run in runs:
        env, network = run.resolved_env.config, run.network_config
        is_bump = run.task in bumps
        assert (env.action_sequence, env.in_hand_mode) == ("pxyzrrr", "proj")
        assert (env.obs_size, env.in_hand_size) == (128, 40 if is_bump else 24)
        assert run.demonstrations == (200 if is_bump else 1000)
        assert (network.num_rotations, network.num_z, network.num_tilts) == (16, 36, 7)
        assert (network.min_z_m, network.max_z_m, network.patch_size) == (0.02, 0.20, None)
        assert network.max_tilt_rad == pytest.approx(math.pi / 8)
        if run.network["name"] == "equi_deictic_asr":
            assert (network.scene_head, network.swap_fingers) == ("flatten", False)
        check_open_loop(run)
    labels = {run.label for run in runs}
    assert {"sdqfd equi_deictic_asr", "sdqfd asr", "adet equi_deictic_asr"} < labels
    assert "adet asr" not in labels


def test_offline_learning_reads_each_set_and_plays_no_episode(monkeypatch):
    monkeypatch.setattr(
        "ba_torchrl.demonstrations.demo_files.check_demonstrations", lambda *_, **__: None
    )
    config, _, runs = shipped("offline")
    methods = {"close_loop": {"bc cnn", "iql cnn"}, "open_loop": {"bc asr", "sdqfd asr"}}
    found = {(run.task, run.label) for run in runs}
    assert found == {
        (task, f"{method} {dataset}")
        for task in config.tasks
        for method in methods[TASKS[task].control]
        for dataset in ("random", "medium", "expert", "mixed")
    }
    assert len(found) == 64
    for run in runs:
        assert run.demonstrations_path == f"graded/{run.task}/{run.label.split()[-1]}"
        assert run.pretrain_updates == run.total_updates
        assert not run.only_successful_demonstrations
