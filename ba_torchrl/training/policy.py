"""Trained policies: loaded from a run, or from the files that the package ships.

A policy in a file is ``NAME.safetensors``, its parameters, and ``NAME.json``, its `PolicyCard`.
"""

from __future__ import annotations

import logging
import shlex
import textwrap
from collections.abc import Iterable, Mapping
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core import keys
from ba_torchrl.core.config import Interval, StrictModel, expanded, explain
from ba_torchrl.core.errors import ConfigError, DamagedFilesError, UnknownNameError, check_choice
from ba_torchrl.core.files import atomic_output, json_bytes, write_tensors, write_text
from ba_torchrl.core.hardware import hardware
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.results import (
    RESULT_FILE,
    RunResult,
    TestedPolicy,
    now,
    read_result,
    versions,
)
from ba_torchrl.record.statistics import wilson
from ba_torchrl.tasks.base import TASKS, Versions, versions_of
from ba_torchrl.training.checkpoint import Which, find_checkpoint, load, parse_saved, read_versions
from ba_torchrl.training.config import SET_BY_THE_EXPERIMENT, ExperimentConfig
from ba_torchrl.training.learner import build_to_load
from ba_torchrl.training.precision import precision
from ba_torchrl.training.protocol import PROTOCOL, count_parameters

logger = logging.getLogger(__name__)

TENSORS, CARD = ".safetensors", ".json"
_OF_TRAINING = {
    "logger": "csv",
    "collector": {"name": "single"},
    "demonstrations_path": None,
    "demonstrations_mapping": None,
}
"""Fields of a run that its policy does not need, with values that need no package or file."""


_OF_RESULT = (
    "expert_version",
    "demonstrations",
    "demonstration_steps",
    "env_steps",
    "expert_labels",
    "hardware",
    "versions",
)
"""Entries of a run's result that its policy's card has."""

_OF_IMAGES = ("workspace", "in_hand_mode", "view_type", "view_scale")
"""Parameters of an environment that change the content of images and not their shape."""
_WAY_OUT = "policy.make_env(), or a command without env.*, makes the environment of its training"


class PolicyCard(StrictModel):
    """What is known of a policy in a file."""

    format: Literal[5] = 5
    """1: kernels whose signs depended on the CPU. 2: no versions, and episodes of other seeds. 3: a
    configuration of another form. 4: no checksum of the weights."""
    policy_file: str
    """SHA-256 of the file of the weights. Card and weights get their names one after the other, and
    are copied separately."""
    task: str
    task_version: int
    """Of the training and of the episodes."""
    label: str
    """Name of the method, such as "sacfd equi"."""
    config: dict[str, Any]
    """The configuration of the run, from which the networks are built; without where it ran."""
    updates: int
    """Gradient updates of the policy."""
    success_rate: float
    """Of the policy's test, whose record is exact."""
    interval: Interval
    """Wilson's interval of the success rate, 95 %."""
    episodes: int
    """Number of episodes of the test."""
    protocol: int | None = None
    """Version of the protocol of the test; None for one before protocol 1, which is not citable."""
    precision: str | None = None
    """Number format of the networks in the test."""
    evaluate: str
    """The command that plays the test again, in the folder of the file."""
    expert_version: int | None = None
    """As in the run's result; None also if it is not known, likewise below."""
    demonstrations: int | None = None
    """Episodes of demonstrations."""
    demonstration_steps: int | None = None
    """Steps of these episodes."""
    env_steps: int | None = None
    """Environment steps of the run, demonstrations not counted."""
    expert_labels: int | None = None
    """States besides demonstrations that the expert labelled with its action."""
    minutes: float | None = None
    """Duration of the run."""
    hardware: dict[str, Any] = Field(default_factory=dict)
    """Machine of the run."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of Python and the packages in the run."""


class TrainedPolicy(TensorDictModuleBase):
    """A greedy policy in evaluation mode: no gradients, no exploration, constant weights.

    It refuses observations of other shapes than in training. The actions and the task of an
    environment are compared by `check_env`, which the package's ``rollout`` and commands call.

    Args:
        learner: whose policy it is.
        config: of the run that trained it.
        updates: gradient updates of the policy.
        source: file or folder that it is from.
        versions: of the task and its expert in the training.
        card: what is known of it, if it is from a file.
    """

    def __init__(
        self,
        learner: Learner,
        config: ExperimentConfig,
        updates: int,
        source: Path,
        versions: Versions,
        card: PolicyCard | None = None,
    ) -> None:
        super().__init__()
        self.policy = learner.policy.requires_grad_(False)
        self.in_keys, self.out_keys = list(learner.policy.in_keys), [keys.ACTION]
        images = {key: image.shape for key, image in learner.images.items()}
        vectors = {key: (length,) for key, length in learner.vectors.items()}
        known = {**images, **vectors, keys.HOLDING: (1,)}
        self.shapes = {key: known[key] for key in self.in_keys if key in known}
        """Shape of each image and vector that the policy reads, without batch dimensions."""
        self._warned: set[str] = set()
        self.config, self.updates, self.source, self.card = config, updates, source, card
        self.versions = versions
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

    def make_env(self, **changes: Any) -> BulletArmEnv:
        """Make the environment that the policy was trained in.

        Args:
            changes: fields of `ba_torchrl.core.env_config.EnvConfig` with other values, such as
                ``seed=0``.
        """
        return make(self.task, **{**self.env_config, **changes})

    def check_env(self, env: EnvBase) -> None:
        """Check that an environment observes what the policy reads and takes its actions.

        Another task, or images with other content, are logged as a warning, once. Other parameters,
        such as the robot, may differ. Of environments that are not `make`'s or `make_vector_env`'s,
        with or without transforms, only the observations are known.

        Raises:
            ConfigError: it observes other shapes, or its actions have another meaning.
        """
        specs = env.observation_spec
        observed = {key: specs[key].shape for key in self.shapes if key in specs.keys(True)}
        self._check_observed(self.shapes, observed)
        while isinstance(env, TransformedEnv):
            env = env.base_env
        here, trained = vars(env).get("resolved"), self.config.resolved_env
        if here is None:
            return
        if here.actions != trained.actions:
            raise ConfigError(
                f"the policy of {self.task} gives {trained.actions}, the environment takes "
                f"{here.actions}: {_WAY_OUT}"
            )
        changes = [("task", self.task, here.task_id)]
        changes += [
            (name, getattr(trained.config, name), getattr(here.config, name)) for name in _OF_IMAGES
        ]
        found = ", ".join(f"{name} {new}, not {old}" for name, old, new in changes if new != old)
        if found and found not in self._warned:
            self._warned.add(found)
            logger.warning("the policy was trained in another environment; here: %s", found)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; the observation may be on another device than the policy.

        Raises:
            ConfigError: the observation lacks an entry that the policy reads, or its shape is
                another than in training.
        """
        entries = {key: tensordict.get(key, None) for key in self.in_keys}
        observed = {key: value.shape for key, value in entries.items() if value is not None}
        self._check_observed(self.in_keys, observed)
        device = next(self.parameters()).device
        with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
            found = self.policy(tensordict.select(*self.in_keys).to(device))[keys.ACTION]
        action = found.to(tensordict.device or found.device, torch.float32)
        return tensordict.set(keys.ACTION, action)

    def _check_observed(
        self, wanted: Iterable[NestedKey], observed: Mapping[NestedKey, torch.Size]
    ) -> None:
        """Check that entries are observed, with shapes that end in those of training."""
        if missing := [key for key in wanted if key not in observed]:
            raise ConfigError(
                f"the policy of {self.task} reads {', '.join(map(str, missing))}, which is not "
                f"observed: {_WAY_OUT}"
            )
        others = [
            f"{key} of shape {list(shape)}, and this is {list(observed[key][-len(shape) :])}"
            for key, shape in self.shapes.items()
            if observed[key][-len(shape) :] != shape
        ]
        if others:
            raise ConfigError(f"the policy of {self.task} reads {'; '.join(others)}: {_WAY_OUT}")

    def __repr__(self) -> str:
        return f"TrainedPolicy({self.task}, {self.config.label}, update {self.updates})"


def load_policy(
    source: str | Path,
    which: Which = "best",
    device: str | torch.device = "cpu",
    **changes: Any,
) -> TrainedPolicy:
    """Load a trained policy.

    Args:
        source: id of a task, for the policy that the package ships; a run folder or one of its
            checkpoints; or a ``.safetensors`` file that ``ba-torchrl export`` wrote.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest".
        device: where it is computed.
        changes: further fields of `ExperimentConfig` to override.

    Returns:
        A TensorDict module that reads `in_keys` and writes ``action``. ``policy.make_env()`` makes
        its environment. A warning says if it was trained in another version of its task.

    Raises:
        ConfigError: there is no such policy, its files are damaged or do not belong together, or it
            names plugins that are neither imported nor installed.
    """
    check_choice("which", which, Which)
    changes = {**_OF_TRAINING, "device": str(device), **changes}
    if str(source) in TASKS:
        path = shipped_file(str(source))
        if not path.exists():
            known = ", ".join(shipped_policies()) or "none"
            raise ConfigError(f"no trained policy of {source} is shipped; those that are: {known}")
    else:
        path = Path(expanded(source))
        if not path.exists():
            hint = f"; and there is no run folder and no file of a policy {source}"
            raise UnknownNameError("policy", str(source), shipped_policies(), hint)
    if path.suffix != TENSORS:
        checkpoint = find_checkpoint(path, which)
        config, algorithm = load(checkpoint, **changes)
        versions = read_versions(checkpoint.parent.parent)
        _warn_of_version(config.task, versions)
        return TrainedPolicy(algorithm, config, algorithm.updates, checkpoint, versions)
    card = read_card(path)
    try:
        weights = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    if sha256(weights).hexdigest() != card.policy_file:
        raise DamagedFilesError(
            f"{path} does not have the weights of its card, {path.with_suffix(CARD).name}: copy "
            "both files again, or export the policy again"
        )
    changes = {"run_dir": str(path.parent), "resume": False, **changes}
    config = parse_saved(card.config, path.with_suffix(CARD), **changes)
    learner = build_to_load(config)
    try:
        learner.policy.load_state_dict(load_tensors(weights))
    except (RuntimeError, SafetensorError) as error:
        reason = textwrap.shorten(str(error), 300)
        raise ConfigError(f"{path} does not hold the policy of its card: {reason}") from None
    versions = Versions(card.task_version, card.expert_version)
    _warn_of_version(card.task, versions)
    return TrainedPolicy(learner, config, card.updates, path, versions, card)


def _warn_of_version(task: str, trained: Versions) -> None:
    """Say that a policy was trained in another version of its task."""
    here = versions_of(task).task
    if trained.task != here:
        logger.warning(
            "the policy was trained in version %d of %s, which has version %d here: its success is "
            "not comparable",
            trained.task,
            task,
            here,
        )


def round_weights(policy: TrainedPolicy) -> None:
    """Round the weights to half precision, the format of files."""
    for value in policy.policy.state_dict().values():
        if value.is_floating_point():
            value.copy_(value.half())


def save_policy(policy: TrainedPolicy, path: str | Path, test: TestedPolicy) -> PolicyCard:
    """Write a policy and its card. Weights are stored in half precision.

    Args:
        policy: from a run, after `round_weights`.
        path: ends in ``.safetensors``; the card is beside it.
        test: of this very policy, under the protocol.

    Raises:
        ConfigError: another process writes the file, or it was trained in another version of its
            task.
        OSError: there is not enough space, or a file cannot be written.
    """
    path = Path(path)
    if policy.versions.task != versions_of(policy.task).task:
        raise ConfigError(
            f"the policy was trained in version {policy.versions.task} of {policy.task}, and its "
            f"episodes are of version {versions_of(policy.task).task}: train it again"
        )
    run: dict[str, Any] = {"expert_version": policy.versions.expert}
    folder = policy.source.parent.parent
    if (folder / RESULT_FILE).exists():
        result = read_result(folder)
        run = {
            "minutes": round(result.seconds / 60, 1),
            **{name: getattr(result, name) for name in _OF_RESULT},
        }
    config = policy.config.resolved()
    for name in ("run_dir", "resume", "device", *_OF_TRAINING):
        del config[name]
    is_shipped = path.resolve() == shipped_file(policy.task)
    source = policy.task if is_shipped else path.name
    words = [f"policy={source}", f"episodes={test.episodes}"]
    if policy.config.plugins:
        words.append(f"plugins=[{','.join(policy.config.plugins)}]")
    tensors = {name: value.detach().cpu() for name, value in policy.policy.state_dict().items()}
    with atomic_output(path, replace=True) as scratch:
        write_tensors(
            scratch,
            {
                name: value.half() if value.is_floating_point() else value.clone()
                for name, value in tensors.items()
            },
        )
        scratch.chmod(0o644)  # safetensors makes it readable for its owner alone
        card = PolicyCard(
            policy_file=sha256(scratch.read_bytes()).hexdigest(),
            task=policy.task,
            task_version=policy.versions.task,
            label=policy.config.label,
            config=config,
            updates=policy.updates,
            **_of_test(test, PROTOCOL, precision(policy.config)),
            evaluate=shlex.join(["ba-torchrl", "evaluate", *words]),
            **run,
        )
        write_text(scratch.with_suffix(CARD), card.model_dump_json(indent=2) + "\n")
    return card


def _of_test(test: TestedPolicy, protocol: int, precision: str) -> dict[str, Any]:
    """Return the fields of a card that a test determines."""
    return {
        "success_rate": test.success_rate,
        "interval": tuple(map(float, wilson(test.success_rate, test.episodes)[1:])),
        "episodes": test.episodes,
        "protocol": protocol,
        "precision": precision,
    }


def tested_card(card: PolicyCard, record: RunResult) -> PolicyCard:
    """Return a card with the number of the record of its policy's test."""
    found = _of_test(record.last, record.protocol, record.precision)
    episodes = f"episodes={record.last.episodes}"
    command = card.evaluate.replace(f"episodes={card.episodes}", episodes)
    return card.model_copy(update={**found, "evaluate": command})


def policy_result(policy: TrainedPolicy, test: TestedPolicy) -> RunResult:
    """Return the record of the test of a policy from a file, on this machine."""
    config, card = policy.config, policy.card
    settings = config.resolved()
    for name in ("run_dir", "resume", "device"):
        del settings[name]
    return RunResult(
        protocol=PROTOCOL,
        task=policy.task,
        task_version=config.resolved_env.task_class.version,
        expert_version=card.expert_version,
        label=card.label,
        benchmark=config.benchmark,
        seed=config.seed,
        curve=[],
        last=test,
        best=test,
        policy_file=card.policy_file,
        demonstrations=card.demonstrations,
        demonstration_steps=card.demonstration_steps,
        env_steps=card.env_steps,
        expert_labels=card.expert_labels,
        precision=precision(config),
        parameters=count_parameters(policy.policy),
        config=settings,
        versions=versions(),
        hardware=hardware(config.torch_device),
        seconds=None if card.minutes is None else 60 * card.minutes,
        phase_seconds={},
        finished=now(),
        files={},
    )


def read_card(path: str | Path) -> PolicyCard:
    """Read the card of a policy's file."""
    file = Path(path).with_suffix(CARD)
    try:
        return PolicyCard.model_validate_json(json_bytes(file))
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from None
    except ValidationError as error:
        found = explain(error, PolicyCard, "card")
        raise ConfigError(f"this version cannot use {file}: {found}") from None


def shipped_file(task: str) -> Path:
    """Return the file in which the package ships the policy of a task."""
    return Path(str(files("ba_torchrl"))) / "policies" / f"{task}{TENSORS}"


def shipped_policies() -> list[str]:
    """Return the tasks of which the package ships a policy."""
    return [task for task in TASKS if shipped_file(task).exists()]
