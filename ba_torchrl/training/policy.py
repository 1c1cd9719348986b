"""Trained policies: loaded from a run, or from the files that the package ships.

A policy in a file is ``NAME.safetensors``, its parameters, and ``NAME.json``, its `PolicyCard`.
"""

from __future__ import annotations

import shlex
import textwrap
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.config import StrictModel, explain
from ba_torchrl.data.files import complete_only, json_bytes, write_tensors, write_text
from ba_torchrl.envs import keys
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.errors import ConfigError, known_names
from ba_torchrl.record.results import RESULT_FILE, read_result, wilson_interval
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.checkpoint import (
    Which,
    build_algorithm,
    find_checkpoint,
    load,
    parse_saved,
)
from ba_torchrl.training.config import SET_BY_THE_EXPERIMENT, ExperimentConfig

TENSORS, CARD = ".safetensors", ".json"
_OF_TRAINING = {
    "logger": "csv",
    "collector": {"name": "single"},
    "demonstrations_path": None,
    "demonstrations_mapping": None,
}
"""Fields of a run that its policy does not need, with values that need no package or file."""


class PolicyCard(StrictModel):
    """What is known of a policy in a file."""

    format: Literal[2] = 2
    """1: weights of kernels whose signs depended on the CPU."""
    task: str
    label: str
    """Name of the method, such as "sacfd equi"."""
    config: dict[str, Any]
    """The configuration of the run, from which the networks are built; without where it ran."""
    updates: int
    """Gradient updates of the policy."""
    success_rate: float
    """Of greedy episodes that training did not use."""
    interval: tuple[float, float]
    """Wilson's interval of the success rate, 95 %."""
    episodes: int
    """Number of these episodes."""
    seed: int
    """Of these episodes."""
    evaluate: str
    """The command that plays them again, in the folder of the file."""
    env_steps: int | None = None
    """Environment steps of the run, demonstrations not counted."""
    minutes: float | None = None
    """Duration of the run."""
    hardware: dict[str, Any] = Field(default_factory=dict)
    """Machine of the run."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of Python and the packages in the run."""


class TrainedPolicy(TensorDictModuleBase):
    """A greedy policy in evaluation mode: no gradients, no exploration, constant weights.

    Args:
        policy: from a root TensorDict to ``action``.
        config: of the run that trained it.
        updates: gradient updates of the policy.
        source: file or folder that it is from.
        card: what is known of it, if it is from a file.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        config: ExperimentConfig,
        updates: int,
        source: Path,
        card: PolicyCard | None = None,
    ) -> None:
        super().__init__()
        self.policy = policy.requires_grad_(False)
        self.in_keys, self.out_keys = list(policy.in_keys), [keys.ACTION]
        self.config, self.updates, self.source, self.card = config, updates, source, card
        self.eval()

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.config.task

    @property
    def env_config(self) -> dict[str, Any]:
        """Keywords for `ba_torchrl.make` and `ba_torchrl.make_vector_env`, besides the task."""
        usual = resolve_env(self.task, {}).config
        return {
            name: value
            for name, value in self.config.resolved_env.config
            if value != getattr(usual, name) and name not in SET_BY_THE_EXPERIMENT
        }

    @property
    def test_seed(self) -> int:
        """Seed of episodes that training did not use."""
        return self.config.derived_seed(SeedUse.TEST)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; the observation may be on another device than the policy.

        Raises:
            ConfigError: the observation lacks an entry that the policy reads.
        """
        if missing := [key for key in self.in_keys if key not in tensordict.keys(True)]:
            raise ConfigError(
                f"the policy of {self.task} reads {', '.join(map(str, missing))}, which is not "
                "observed: make the environment with **policy.env_config"
            )
        device = next(self.parameters()).device
        with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
            found = self.policy(tensordict.select(*self.in_keys).to(device))[keys.ACTION]
        return tensordict.set(keys.ACTION, found.to(tensordict.device or found.device))

    def __repr__(self) -> str:
        return f"TrainedPolicy({self.task}, {self.config.label}, update {self.updates})"


def load_policy(
    source: str | Path, which: Which = "best", device: str = "cpu", **changes: Any
) -> TrainedPolicy:
    """Load a trained policy.

    Args:
        source: id of a task, for the policy that the package ships; a run folder or one of its
            checkpoints; or a ``.safetensors`` file that ``ba-torchrl export`` wrote.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest".
        device: where it is computed.
        changes: further fields of `ExperimentConfig` to override.

    Returns:
        A TensorDict module that reads `in_keys` and writes ``action``. ``make(policy.task,
        **policy.env_config)`` makes its environment.

    Raises:
        ConfigError: there is no such policy, its files are damaged, or it names plugins that are
            neither imported nor installed.
    """
    changes = {**_OF_TRAINING, "device": device, **changes}
    if str(source) in TASKS:
        path = shipped_file(str(source))
        if not path.exists():
            known = ", ".join(shipped_policies()) or "none"
            raise ConfigError(f"no trained policy of {source} is shipped; those that are: {known}")
    else:
        path = Path(source)
        if not path.exists():
            raise ConfigError(
                f"{source} is neither a run folder, a file of a policy nor a task with a trained "
                f"policy.{known_names(str(source), shipped_policies())}"
            )
    if path.suffix != TENSORS:
        checkpoint = find_checkpoint(path, which)
        config, algorithm = load(checkpoint, **changes)
        return TrainedPolicy(algorithm.policy, config, algorithm.updates, checkpoint)
    card = read_card(path)
    changes = {"run_dir": str(path.parent), "resume": False, **changes}
    config = parse_saved(card.config, path.with_suffix(CARD), **changes)
    policy = build_algorithm(config).policy
    try:
        policy.load_state_dict(load_file(path, device=str(config.torch_device)))
    except (OSError, RuntimeError, SafetensorError) as error:
        reason = textwrap.shorten(str(error), 300)
        raise ConfigError(f"{path} does not hold the policy of its card: {reason}") from None
    return TrainedPolicy(policy, config, card.updates, path, card)


def round_weights(policy: TrainedPolicy) -> None:
    """Round the weights to half precision, the format of files."""
    for value in policy.policy.state_dict().values():
        if value.is_floating_point():
            value.copy_(value.half())


def save_policy(
    policy: TrainedPolicy,
    path: str | Path,
    *,
    successes: int,
    episodes: int,
    seed: int,
    num_envs: int,
) -> PolicyCard:
    """Write a policy and its card. Weights are stored in half precision.

    Args:
        policy: from a run, after `round_weights`.
        path: ends in ``.safetensors``; the card is beside it.
        successes: of ``episodes`` greedy episodes.
        episodes: number of episodes that were played.
        seed: of these episodes.
        num_envs: number of environments that played them.

    Raises:
        ConfigError: another process writes the file.
        OSError: there is not enough space, or a file cannot be written.
    """
    path = Path(path)
    run: dict[str, Any] = {}
    folder = policy.source.parent.parent
    if (folder / RESULT_FILE).exists():
        result = read_result(folder)
        run = {
            "minutes": round(result.seconds / 60, 1),
            "env_steps": result.curve[-1].env_steps,
            "hardware": result.hardware,
            "versions": result.versions,
        }
    config = policy.config.resolved()
    for name in ("run_dir", "resume", "device", *_OF_TRAINING):
        del config[name]
    is_shipped = path.resolve() == shipped_file(policy.task)
    words = ["policy=trained", f"task={policy.task}"] if is_shipped else [f"policy={path.name}"]
    words += [f"{episodes=}", f"{num_envs=}"]
    if seed != policy.test_seed:
        words.append(f"{seed=}")
    if policy.config.plugins:
        words.append(f"plugins=[{','.join(policy.config.plugins)}]")
    card = PolicyCard(
        task=policy.task,
        label=policy.config.label,
        config=config,
        updates=policy.updates,
        success_rate=successes / episodes,
        interval=wilson_interval(successes, episodes),
        episodes=episodes,
        seed=seed,
        evaluate=shlex.join(["ba-torchrl", "evaluate", *words]),
        **run,
    )
    tensors = {name: value.detach().cpu() for name, value in policy.policy.state_dict().items()}
    with complete_only(path, replace=True) as scratch:
        write_tensors(
            scratch,
            {
                name: value.half() if value.is_floating_point() else value.clone()
                for name, value in tensors.items()
            },
        )
        scratch.chmod(0o644)  # safetensors makes it readable for its owner alone
        write_text(scratch.with_suffix(CARD), card.model_dump_json(indent=2) + "\n")
    return card


def read_card(path: str | Path) -> PolicyCard:
    """Read the card of a policy's file.

    Raises:
        ConfigError: there is none, or it is not a card.
    """
    file = Path(path).with_suffix(CARD)
    try:
        return PolicyCard.model_validate_json(json_bytes(file))
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from None
    except ValidationError as error:
        found = explain(error, PolicyCard.model_fields, "card")
        raise ConfigError(f"this version cannot use {file}: {found}") from None


def shipped_file(task: str) -> Path:
    """Return the file in which the package ships the policy of a task."""
    return Path(str(files("ba_torchrl"))) / "policies" / f"{task}{TENSORS}"


def shipped_policies() -> list[str]:
    """Return the tasks of which the package ships a policy."""
    return [task for task in TASKS if shipped_file(task).exists()]
