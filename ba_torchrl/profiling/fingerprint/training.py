"""Record a short training run."""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ba_torchrl.profiling.fingerprint.cases import Case, config_folder
from ba_torchrl.profiling.fingerprint.marks import tensors, tensors_mark

NOT_RECORDED = ("run_dir", "resume", "label")
"""Fields of a run's configuration that do not affect its numbers."""


def _composed(case: Case, run_dir: str) -> dict[str, Any]:
    """Return the values that Hydra composes for a training run."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from ba_torchrl.training import hydra_schema

    overrides = dict(case.config)
    file = overrides.pop("file")
    lines = [f"{name}={json.dumps(value)}" for name, value in overrides.items()]
    hydra_schema.register()
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        settings = compose(file, overrides=[*lines, f"seed={case.seed}", f"run_dir={run_dir}"])
    return OmegaConf.to_container(settings, resolve=True)


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dictionaries under dotted names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def run_training(case: Case, facts: dict[str, Any], traces: dict[str, Any]) -> None:
    """Train for a few updates; record every scalar, the last parameters and the evaluation."""
    from ba_torchrl.training.config import ExperimentConfig
    from ba_torchrl.training.experiment import Experiment

    with tempfile.TemporaryDirectory() as folder:
        values = _composed(case, f"{folder}/run")
        facts |= {
            f"config {name}": value
            for name, value in _flat(values)
            if name.split(".")[0] not in NOT_RECORDED
        }
        experiment = Experiment(ExperimentConfig.parse(values), progress=False)
        result = experiment.run()
        with (Path(folder) / "run" / "scalars.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    steps: dict[str, dict[str, Any]] = {}
    for row in rows:
        steps.setdefault(row["step"], {})[row["name"]] = [row["value"], [float(row["value"])]]
    traces["scalars"] = {"facts": {"updates": " ".join(steps)}, "steps": list(steps.values())}
    facts["updates"] = result.updates
    for name in ("episodes", "success_rate", "mean_length"):
        facts[f"evaluation {name}"] = getattr(result.evaluation, name)
    for name, state in experiment.algorithm.state_dict().items():
        if any(True for _ in tensors(state)):
            facts[f"tensors of {name}"] = tensors_mark(state)
    facts["tensors of the policy"] = tensors_mark(experiment.algorithm.policy.state_dict())
