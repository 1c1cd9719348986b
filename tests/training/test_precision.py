"""What a run says of its hardware and of the time that it takes."""

import time

import pytest
import torch

from ba_torchrl.core import hardware
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.training import experiment
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation
from ba_torchrl.training.experiment import Experiment
from ba_torchrl.training.precision import compute_path
from tests.training.test_experiment import TINY, tiny


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_path_names_number_format_and_processor(tmp_path, precision):
    network = {**TINY["network"], "precision": precision}
    config = ExperimentConfig.parse({**TINY, "network": network, "device": "cpu"})
    path = compute_path(config)
    assert path.startswith(f"{precision} on ")
    assert path.endswith(f"{torch.get_num_threads()} threads")


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [
        ({"avx2": True, "avx512_f": True, "amx_bf16": True}, " (AMX)"),
        ({"avx2": True, "avx512_f": True, "amx_bf16": False}, " (AVX-512)"),
        ({"avx2": True}, " (AVX2)"),
        ({"architecture": "aarch64"}, ""),
    ],
)
def test_the_processor_is_named_with_its_widest_instructions(monkeypatch, capabilities, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    monkeypatch.setattr(hardware, "_processor_name", lambda: "Xeon")
    assert hardware.processor() == f"Xeon{expected}"


@pytest.mark.parametrize("variable", ["ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"])
@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ("AVX512_CORE", " (AVX-512, oneDNN limited to AVX512_CORE)"),
        ("avx512_core_amx", " (AMX, oneDNN limited to AVX512_CORE_AMX)"),
        ("ALL", " (AMX)"),
    ],
)
def test_a_limit_of_the_instructions_is_named(monkeypatch, variable, limit, expected):
    has_amx = {"avx2": True, "avx512_f": True, "amx_bf16": True}
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    monkeypatch.setenv(variable, limit)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: has_amx)
    monkeypatch.setattr(hardware, "_processor_name", lambda: "Xeon")
    assert hardware.processor() == f"Xeon{expected}"
    assert hardware.amx_is_used() is ("AMX" in expected)


def test_a_run_logs_how_long_its_updates_will_take(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(experiment, "WARM_UP_UPDATES", 2)
    monkeypatch.setattr(experiment, "MEASURED_UPDATES", 3)
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    config = tiny(tmp_path, total_updates=100)
    with Experiment(config, progress=False) as run, caplog.at_level("INFO"):
        for update in range(1, 8):
            with run.state.timed("updates"):
                now[0] += 1000.0 if update <= 2 else 6.0
            with run.state.timed("evaluation"):
                now[0] += 50.0
            run.learner.updates = update
            run._log_duration()
    (found,) = caplog.messages
    assert "6.00 s an update, at most 10 minutes for the other 95 without evaluations" in found


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        ({}, [6]),  # of six updates
        ({"total_updates": 2}, [2]),  # on the demonstrations alone
        pytest.param({"log_every": 4}, [4], marks=pytest.mark.slow),
        pytest.param({"log_every": 6}, [6], marks=pytest.mark.slow),
        pytest.param({"log_every": 3}, [3, 6], marks=pytest.mark.slow),
        ({"stop_at_success": 1e-9, "eval_every": 1, "eval_episodes": 2}, [2]),
    ],
)
def test_a_run_shorter_than_the_interval_logs_its_last_update(
    tmp_path, changes, steps, monkeypatch
):
    monkeypatch.setattr(
        "ba_torchrl.training.experiment.evaluate", lambda *_: Evaluation(3, 1.0, 0.0, 5.0)
    )
    config = tiny(tmp_path, **{"log_every": 50, "video_episodes": 0, **changes})
    result = Experiment(config, progress=False).run()
    scalars = read_scalars(config.folder)
    for name in ("train/loss_qvalue", "train/env_steps"):
        assert scalars[name].steps.tolist() == steps
    assert scalars["eval/success_rate"].steps[-1] == result.updates
    assert (config.folder / result.files["curve"]).exists()
