import itertools
import json
import math
import os
import shutil
import signal
import sys
from typing import get_args

import matplotlib
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.demo_files import save_demonstrations
from ba_torchrl.demonstrations.exchange import export_demonstrations
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.record.results import Phase, PolicyTest, read_result
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import protocol
from ba_torchrl.training.checkpoint import Checkpoints, find_checkpoint, load
from ba_torchrl.training.collection import gather_demonstrations
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation
from ba_torchrl.training.experiment import Experiment
from ba_torchrl.training.learner import build_learner
from ba_torchrl.training.precision import precision
from tests.recipes import recipe
from tests.tasks.episodes import demonstrations

TINY = {
    "task": "close_loop/block_reaching",
    "env": {"obs_size": 64, "max_steps": 8},
    "algorithm": {
        "name": "sac",
        "batch_size": 8,
        "replay": {"name": "prioritized"},
        "rotation": {"name": "sampled"},
    },
    "network": {"name": "cnn", "width": 0.25},
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 3,
    "pretrain_updates": 2,
    "total_updates": 6,
    "min_replay": 5,
    "eval_every": 3,
    "eval_episodes": 3,
    "final_eval_episodes": 4,
    "log_every": 1,
    "video_episodes": 1,
}
SHORT = {"total_updates": 3, "eval_episodes": 1, "final_eval_episodes": 1, "video_episodes": 0}
"""Changes for a run that only has to work, with one update after those on demonstrations."""


def tiny(tmp_path, **changes):
    return ExperimentConfig.parse({**TINY, "run_dir": str(tmp_path / "run"), **changes})


@pytest.mark.usefixtures("figures")
def test_a_run_writes_its_files(tmp_path):
    result = Experiment(tiny(tmp_path), progress=False).run()
    folder = tmp_path / "run"
    assert result.last.episodes == 4
    assert (folder / result.files["curve"]).read_bytes().startswith(b"\x89PNG")
    assert (folder / result.files["video"]).stat().st_size > 1000
    assert json.loads((folder / "config.json").read_text())["task"] == TINY["task"]
    scalars = read_scalars(folder)
    assert scalars["eval/success_rate"].steps.tolist() == [0, 3, 6]
    assert scalars["final/success_rate"].steps.tolist() == [6]
    assert result.updates == 6
    assert scalars["train/loss_qvalue"].steps.tolist() == [1, 2, 3, 4, 5, 6]
    assert scalars["demonstrations/success_rate"].values[0] == 1.0
    # two pretraining updates, then one per step of both environments
    assert scalars["train/env_steps"].values[-1] == 8
    assert find_checkpoint(folder).name.endswith("6")


@pytest.mark.parametrize("tf32", [None, True, False])
def test_tensor_float_32_is_set_for_convolutions_and_products(tf32, tmp_path):
    places = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [place.allow_tf32 for place in places]
    try:
        Experiment(tiny(tmp_path, tf32=tf32), progress=False)
        found = [place.allow_tf32 for place in places]
    finally:
        for place, value in zip(places, before, strict=True):
            place.allow_tf32 = value
    assert found == (before if tf32 is None else [tf32, tf32])


def test_a_checkpoint_rebuilds_the_policy(tmp_path):
    config = tiny(tmp_path, total_updates=2, video_episodes=0)
    experiment = Experiment(config, progress=False)
    experiment.run()
    loaded_config, loaded = load(tmp_path / "run")
    assert loaded_config == config
    assert loaded.updates == 2
    state = experiment.learner.loss.state_dict()
    for key, value in loaded.loss.state_dict().items():
        assert torch.equal(value, state[key]), key
    depth = torch.rand(3, 1, 64, 64) * 0.3
    holding = torch.zeros(3, 1, dtype=torch.bool)
    observation = TensorDict({"depth": depth, "holding": holding}, batch_size=[3])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        a = experiment.learner.policy(observation.clone())
        b = loaded.policy(observation.clone())
    assert torch.equal(a["action"], b["action"])
    assert set(a.keys()) == {"depth", "holding", "action"}


def test_the_best_checkpoint_is_kept(tmp_path):
    config = tiny(tmp_path)
    checkpoints = Checkpoints(config.folder, build_learner(config), keep_last=1)
    for updates, rate in ((1, 0.9), (2, 0.1), (3, 0.2)):
        checkpoints.save(updates, rate)
    kept = sorted(path.name[-1] for path in (config.folder / "checkpoints").iterdir())
    assert kept == ["1", "3"]


def test_the_last_policy_and_the_best_checkpoint_are_tested(tmp_path, monkeypatch):
    experiment = Experiment(tiny(tmp_path, video_episodes=0), progress=False)
    rates = iter([1.0, 0.9, 0.4])  # the first is of the untrained policy
    weights = []

    def note():
        weights.append(next(experiment.learner.loss.parameters()).detach().clone())

    def evaluate(env, policy, episodes, seed, on_episode):
        note()
        return Evaluation(episodes, next(rates), 0.0, 1.0)

    def run_test(env, policy, updates, episodes, on_episode):
        note()
        seeds = [protocol.test_seed(episode) for episode in range(episodes)]
        return PolicyTest(
            updates=updates, seeds=seeds, successes=[1] * episodes, lengths=[updates] * episodes
        )

    monkeypatch.setattr("ba_torchrl.training.experiment.evaluate", evaluate)
    monkeypatch.setattr("ba_torchrl.training.experiment.run_test", run_test)
    result = experiment.run()
    assert (result.last.updates, result.best.updates) == (6, 3)
    assert [result.files[name][-1] for name in ("checkpoint", "best")] == ["6", "3"]
    assert torch.equal(weights[3], weights[2])
    assert torch.equal(weights[4], weights[1])
    assert not torch.equal(weights[2], weights[1])
    assert torch.equal(next(experiment.learner.loss.parameters()), weights[2])
    assert read_result(tmp_path / "run") == result


@pytest.mark.parametrize(
    ("changes", "labels", "expert"),
    [
        ({}, 0, 0),
        ({"algorithm": {"name": "dagger", "batch_size": 8}}, 8, 0),
        ({"demonstrations": 0, "pretrain_updates": 0}, 0, None),
    ],
)
def test_a_result_counts_what_the_run_used(tmp_path, changes, labels, expert):
    config = tiny(tmp_path, video_episodes=0, **changes)
    experiment = Experiment(config, progress=False)
    experiment.run()
    result = read_result(config.folder)
    assert (result.protocol, result.task_version, result.expert_version) == (1, 0, expert)
    assert result.demonstrations == config.demonstrations
    assert (result.demonstration_steps >= 3) == bool(config.demonstrations)
    assert result.expert_labels == labels
    assert result.env_steps == result.curve[-1].env_steps
    assert result.precision == precision(config)
    policy = experiment.learner.policy
    assert result.parameters == sum(value.numel() for value in policy.parameters()) > 0
    assert result.last.seeds == [protocol.test_seed(episode) for episode in range(4)]
    assert set(result.phase_seconds) == set(get_args(Phase))
    assert result.seconds == pytest.approx(sum(result.phase_seconds.values()))
    used = {name for name, seconds in result.phase_seconds.items() if seconds > 1e-3}
    assert used >= {"updates", "evaluation", "collection", "other"}
    assert ("demonstrations" in used) == bool(config.demonstrations)


@pytest.mark.parametrize(("source", "expert"), [("expert", 3), ("keyboard", None)])
def test_a_result_names_the_expert_of_a_folder(tmp_path, monkeypatch, source, expert):
    env = {"obs_size": 64, "max_steps": 8}
    episodes = demonstrations(TINY["task"], 3, env=env)
    path = tmp_path / "demonstrations"
    with monkeypatch.context() as patch:
        patch.setattr(TASKS[TINY["task"]], "expert_version", 3)
        save_demonstrations(path, episodes, task=TINY["task"], env=env, seed=0, source=source)
    config = tiny(tmp_path, demonstrations_path=str(path), **SHORT)
    Experiment(config, progress=False).run()
    assert read_result(config.folder).expert_version == expert


def test_a_folder_without_a_run_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"config\.json and checkpoints"):
        load(tmp_path)


NO_PRETRAINING = {"pretrain_updates": 0}
FERM = {
    "name": "sac",
    "views": {"name": "crop", "size": 64},
    "contrastive": {"name": "info_nce", "updates": 2},
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "close_loop/flying"}, "unknown task 'close_loop/flying'"),
        ({"task": 3}, "task: must be text"),
        ({"env": {"obs_sise": 64}}, "Did you mean 'obs_size'"),
        ({"env": 3}, "env: must be names with values"),
        ({"env": {"seed": 3}}, "set by the experiment"),
        ({"env": {"obs_type": "vec"}}, "obs_type"),
        ({"algorithm": {"name": "ppo"}}, "unknown algorithm 'ppo'.*sac"),
        ({"algorithm": {"name": "sac", "gama": 0.9}}, "Did you mean 'gamma'"),
        ({"algorithm": {"batch_size": 3}}, "algorithm.name is missing"),
        ({"network": {"name": "mlp"}}, "Known: .*cnn.*equi"),
        ({"network": {"name": "cnn", "width": "wide"}}, "width"),
        ({"total_updates": 1}, r"pretrain_updates \(2\) are part of total_updates \(1\)"),
        ({"min_replay": 100_001}, "min_replay: 100001 transitions are more than the replay holds"),
        ({"algorithm": {"name": "sac", "optimizer": {"learning_rate": math.inf}}}, "learning_rate"),
        ({"demonstrations": 0}, "needs demonstrations"),
        ({"device": "gpu"}, "device"),
        ({"device": "meta"}, "device: use device=cpu"),
        ({"num_envs": 0}, "num_envs"),
        ({"total_update": 5}, "Did you mean 'total_updates'"),
        ({"device": "cuda:99"}, "device: use device=cpu"),
        ({"demonstrations_path": "/no/such/folder"}, "no demonstrations at"),
        (
            {"demonstrations": 0, **NO_PRETRAINING, "demonstrations_path": "/a"},
            "set demonstrations",
        ),
        ({"demonstrations_mapping": "a.yaml"}, "demonstrations_mapping is for demonstrations_path"),
        (
            {"algorithm": FERM, "demonstrations": 0, **NO_PRETRAINING},
            "an update before the first environment step needs demonstrations",
        ),
    ],
)
def test_wrong_configurations_fail_before_the_run_starts(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        tiny(tmp_path, **changes)
    assert not (tmp_path / "run").exists()


def test_demonstrations_of_a_folder_are_filtered(tmp_path, caplog):
    """Episodes of one step are too short for a success."""
    env = {"obs_size": 64, "max_steps": 8}
    for name, steps in (("good", 8), ("bad", 1)):
        task = TINY["task"]
        episodes = demonstrations(task, 3, env={"obs_size": 64, "max_steps": steps})
        save_demonstrations(tmp_path / name, episodes, task=task, env=env, seed=0)
    changes = {"only_successful_demonstrations": True, "demonstrations_turn_noise": 0.5}
    good, bad = (
        tiny(tmp_path, demonstrations_path=str(tmp_path / name), **changes)
        for name in ("good", "bad")
    )
    learner = build_learner(good)
    assert len(gather_demonstrations(good, learner)) == 3
    assert "demonstrations_turn_noise has no effect" in caplog.text
    with pytest.raises(ConfigError, match=r"0 episodes of .* succeed, \d are needed"):
        gather_demonstrations(bad, learner)


def test_demonstrations_of_another_library_are_those_of_the_folder(tmp_path):
    """A run takes an exported file, and with a mapping the same file without its card."""
    env = {"obs_size": 64, "max_steps": 8}
    episodes = demonstrations(TINY["task"], 2, env=env)
    options = {"task": TINY["task"], "env": env, "seed": 0}
    save_demonstrations(tmp_path / "folder", episodes, **options)
    export_demonstrations(tmp_path / "a.hdf5", episodes, format="hdf5", **options)
    shutil.copy(tmp_path / "a.hdf5", tmp_path / "b.hdf5")
    names = {"depth": "obs/depth", "holding": "obs/holding", "action": "actions"}
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("".join(f"{key}: {name}\n" for key, name in names.items()))
    changes = {"demonstrations": 2}
    runs = [
        tiny(tmp_path, demonstrations_path=str(tmp_path / "folder"), **changes),
        tiny(tmp_path, demonstrations_path=str(tmp_path / "a.hdf5"), **changes),
        tiny(
            tmp_path,
            demonstrations_path=str(tmp_path / "b.hdf5"),
            demonstrations_mapping=str(mapping),
            **changes,
        ),
    ]
    for run in runs:
        found = gather_demonstrations(run, build_learner(run))
        for one, other in zip(found, episodes, strict=True):
            assert (one == other).all()
    with pytest.raises(ConfigError, match=r"written by another program.*obs/depth \[64, 64, 1\]"):
        tiny(tmp_path, demonstrations_path=str(tmp_path / "b.hdf5"), **changes)


def test_a_logger_without_its_package_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ba_torchrl.training.config.find_spec", lambda backend: None)
    with pytest.raises(ConfigError, match=r"pip install .*wandb"):
        tiny(tmp_path, logger="wandb")


def test_a_run_whose_video_lacks_a_package_does_not_start(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"pip install .*imageio-ffmpeg"):
        Experiment(tiny(tmp_path, video_episodes=1))
    assert not list(tmp_path.iterdir())
    Experiment(tiny(tmp_path, video_episodes=0)).close()


@pytest.mark.usefixtures("figures")
def test_a_run_whose_figures_fail_is_finished(tmp_path, monkeypatch, caplog):
    """Figures do not depend on the user's settings and labels; what fails is a warning."""

    def film(*_):
        written.append(read_result(tmp_path / "run").files.keys())
        raise OSError("no space for a film")

    written = []
    monkeypatch.setattr("ba_torchrl.training.outputs.record_episodes", film)
    changes = {**SHORT, "video_episodes": 1, "label": "$a_{$ costs"}
    with matplotlib.rc_context({"text.usetex": True, "font.family": "none", "figure.dpi": -1}):
        result = Experiment(tiny(tmp_path, **changes), progress=False).run()
    assert written == [{"checkpoint", "best"}]  # the result is first
    assert result.files.keys() == {"checkpoint", "best", "curve"}
    assert (tmp_path / "run" / result.files["curve"]).read_bytes().startswith(b"\x89PNG")
    assert "run has no video: OSError: no space for a film" in caplog.text
    assert not (tmp_path / "run/resume").exists()


OPEN_LOOP = {
    "task": "open_loop/block_stacking",
    "env": {"obs_size": 32, "num_objects": 2, "max_steps": 4},
    "algorithm": {"name": "spatial_q", "batch_size": 4},
    "network": {"name": "asr", "width": 0.125, "num_rotations": 4},
}


@pytest.mark.parametrize(
    "source", ["deconstruction", pytest.param("expert", marks=pytest.mark.slow)]
)
def test_an_open_loop_run_from_either_source(tmp_path, source):
    config = tiny(tmp_path, **OPEN_LOOP, **SHORT, demonstrations_source=source)
    result = Experiment(config, progress=False).run()
    assert result.updates == 3
    assert result.last.episodes == 1
    scalars = read_scalars(tmp_path / "run")
    assert scalars["demonstrations/success_rate"].values == [1.0]
    _, learner = load(tmp_path / "run")
    assert learner.updates == 3


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        ({"obs_size": 100}, "64 or 128 px, got 100; set obs_size"),
        ({"view_type": "camera_side_rgbd"}, "choose another view_type"),
        ({"view_type": "camera_center_xy"}, "nothing below zero"),
    ],
)
def test_images_that_the_networks_do_not_take_are_refused(tmp_path, env, reason):
    config = tiny(tmp_path, env={**TINY["env"], **env})
    with pytest.raises(ConfigError, match=reason):
        Experiment(config, progress=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("view", ["camera_center_xyzr", "camera_side"])
def test_rotation_is_refused_for_views_that_do_not_rotate_with_the_scene(tmp_path, view):
    env = {**TINY["env"], "view_type": view}
    with pytest.raises(ConfigError, match=r"depth does not rotate.*use rotation.name=none"):
        Experiment(tiny(tmp_path, env=env), progress=False)
    plain = {**TINY["algorithm"], "rotation": {"name": "none"}}
    Experiment(tiny(tmp_path, env=env, algorithm=plain, **SHORT), progress=False).close()


def test_seeds_of_different_uses_and_runs_differ(tmp_path):
    seeds = [tiny(tmp_path, seed=s).derived_seed(use) for s in range(4) for use in SeedUse]
    spread = sorted(seeds)
    assert all(b - a > 1000 for a, b in itertools.pairwise(spread))


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    experiment = Experiment(tiny(tmp_path, video_episodes=0), progress=False)
    with torch.no_grad():
        experiment.learner.loss.log_alpha.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="update 0"):
        experiment.run()


def test_a_run_survives_a_worker_that_dies(tmp_path, monkeypatch):
    changes = {**SHORT, "total_updates": 10}
    config = tiny(tmp_path, parallel=True, start_method="fork", **changes)
    experiment = Experiment(config, progress=False)
    store = experiment._store
    batches = 0

    def kill_then_store(data):
        nonlocal batches
        batches += 1
        if batches == 3:
            os.kill(experiment._collection.env.worker_pids[0], signal.SIGKILL)
        return store(data)

    monkeypatch.setattr(experiment, "_store", kill_then_store)
    experiment.run()
    scalars = read_scalars(config.folder)
    assert scalars["train/faults"].values[-1] == 1
    assert experiment._collection.env.restarts == 1


def test_the_recipes_from_collection_to_evaluation(tmp_path, capsys):
    def printed(name, *overrides, config_name=None):
        recipe(name, *overrides, config_name=config_name)
        return capsys.readouterr().out

    demos = tmp_path / "demos"
    out = printed(
        "collect",
        "task=close_loop/block_reaching",
        "episodes=4",
        "num_envs=2",
        "parallel=false",
        "env.obs_size=64",
        "env.max_steps=10",
        f"path={demos}",
    )
    assert "4 episodes of close_loop/block_reaching, success 1.00" in out
    out = printed(
        "train",
        "task=close_loop/block_reaching",
        "network=cnn",
        "network.width=0.25",
        "algorithm.batch_size=8",
        "demonstrations=4",
        f"demonstrations_path={demos}",
        "pretrain_updates=2",
        "total_updates=3",
        "eval_every=100",
        "eval_episodes=2",
        "env.max_steps=10",
        "final_eval_episodes=4",
        "num_envs=2",
        "video_episodes=1",
        f"run_dir={tmp_path}/run",
        "plugins=[json]",
        config_name="quickstart",
    )
    assert "over 4 episodes" in out
    assert "    import ba_torchrl, json\n" in out
    assert f"{tmp_path}/run/learning_curve.png" in out
    gif = tmp_path / "film.gif"
    out = printed(
        "evaluate",
        f"policy={tmp_path}/run",
        "episodes=3",
        "num_envs=2",
        "parallel=false",
        f"video={gif}",
        "video_episodes=1",
    )
    assert "over 3 episodes of close_loop/block_reaching" in out
    assert "not citable: fewer than 200 episodes" in out
    assert f"update 3, {find_checkpoint(tmp_path / 'run')}" in out
    assert gif.read_bytes().startswith(b"GIF")
