"""Trained policies: loaded from a run, or from the files that the package ships.

A policy in a file is ``NAME.safetensors``: its weights, and in the header the result of its test.
"""

from __future__ import annotations

import logging
import shlex
import textwrap
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors, save as save_tensors
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core import keys
from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import ConfigError, DamagedFilesError, UnknownNameError, check_choice
from ba_torchrl.core.files import atomic_file, errors_naming, header_texts, json_bytes
from ba_torchrl.core.hardware import hardware, usable_device
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.record.results import (
    NON_LEARNING_FIELDS,
    POLICY_RESULT,
    POLICY_SUFFIX,
    RESULT_FILE,
    Machine,
    PolicyTest,
    RunResult,
    now,
    read_result,
    shipped_file,
    shipped_policies,
    versions,
)
from ba_torchrl.tasks.base import TASKS, Versions, versions_of
from ba_torchrl.training.checkpoint import Which, find_checkpoint, load, parse_saved, read_versions
from ba_torchrl.training.config import SET_BY_THE_EXPERIMENT, ExperimentConfig
from ba_torchrl.training.learner import build_to_load
from ba_torchrl.training.precision import precision
from ba_torchrl.training.protocol import PROTOCOL, count_parameters

logger = logging.getLogger(__name__)

_OF_TRAINING = {
    "logger": "csv",
    "collector": {"name": "single"},
    "demonstrations_path": None,
    "demonstrations_mapping": None,
}
"""Fields of a run that its policy does not need, with values that need no package or file."""
_OF_POLICY = {"plugins", "label", "benchmark"}
"""Fields that do not affect learning and belong to a policy, not to the machine of its training."""
_COUNTS = ("demonstrations", "demonstration_steps", "env_steps", "expert_labels", "seconds")
"""Entries of a run's result that the result of its policy has."""
_OF_IMAGES = ("workspace", "in_hand_mode", "view_type", "view_scale")
"""Parameters of an environment that change the content of images and not their shape."""
_WAY_OUT = "policy.make_env(), or a command without env.*, makes the environment of its training"


class _Card(BaseModel, extra="ignore"):
    """The file ``NAME.json`` that earlier versions wrote beside ``NAME.safetensors``."""

    format: Literal[5]
    policy_file: str
    """SHA-256 of the other file."""
    config: dict[str, Any]
    updates: int
    task_version: int
    expert_version: int | None = None


class EnvPolicy(TensorDictModuleBase):
    """A policy that knows the environment of its training, and checks others.

    Subclasses set ``in_keys``, ``out_keys``, `shapes` and `resolved_env`.
    """

    shapes: Mapping[NestedKey, tuple[int, ...]]
    """Shape of each image and vector that the policy reads, without batch dimensions."""
    resolved_env: ResolvedEnv
    """The environment of the training."""

    def __init__(self) -> None:
        super().__init__()
        self._warned: set[str] = set()

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.resolved_env.task_id

    @property
    def env_config(self) -> dict[str, Any]:
        """Keywords for `ba_torchrl.make` and `ba_torchrl.make_vector_env`, besides the task."""
        usual = resolve_env(self.task, {}).config
        return {
            name: value
            for name, value in self.resolved_env.config
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
        here, trained = vars(env).get("resolved"), self.resolved_env
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

    def _check_observed(
        self, wanted: Iterable[NestedKey], observed: Mapping[NestedKey, torch.Size]
    ) -> None:
        """Check that entries are observed, with shapes that end in the shapes of training."""
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


class TrainedPolicy(EnvPolicy):
    """A greedy policy in evaluation mode: no gradients, no exploration, constant weights.

    It refuses observations of other shapes than in training. The actions and the task of an
    environment are compared by `check_env`, which the package's ``rollout`` and commands call.

    Args:
        learner: whose policy it is.
        config: of the run that trained it.
        updates: gradient updates of the policy.
        source: file or folder that it is from.
        versions: of the task and its expert in the training.
        result: of its test, if it is from a file.
    """

    def __init__(
        self,
        learner: Learner,
        config: ExperimentConfig,
        updates: int,
        source: Path,
        versions: Versions,
        result: RunResult | None = None,
    ) -> None:
        super().__init__()
        self.policy = learner.policy.requires_grad_(False)
        self.in_keys, self.out_keys = (
            list(names) for names in (learner.policy.in_keys, learner.policy.out_keys)
        )
        images = {key: image.shape for key, image in learner.images.items()}
        vectors = {key: (length,) for key, length in learner.vectors.items()}
        known = {**images, **vectors, keys.HOLDING: (1,)}
        self.shapes = {key: known[key] for key in self.in_keys if key in known}
        self.resolved_env = config.env.without_window()
        self.config, self.updates, self.source = config, updates, source
        self.versions, self.result = versions, result
        self.eval()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``, and what the policy carries to the next step; the observation may be on
        another device than the policy.

        Raises:
            ConfigError: the observation lacks an entry that the policy reads, or its shape is
                another than in training.
        """
        entries = {key: tensordict.get(key, None) for key in self.in_keys}
        observed = {key: value.shape for key, value in entries.items() if value is not None}
        self._check_observed(self.in_keys, observed)
        device = next(self.parameters()).device
        with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
            seen = tensordict.select(*self.in_keys, keys.CARRIED, strict=False).to(device)
            found = self.policy(seen).select(*self.out_keys)
        found[keys.ACTION] = found[keys.ACTION].float()
        return tensordict.update(found.to(tensordict.device or device))

    def __repr__(self) -> str:
        return f"TrainedPolicy({self.task}, {self.config.label}, update {self.updates})"


def load_policy(
    source: str | Path,
    which: Which = "best",
    device: str | torch.device = "cpu",
    acting: Mapping[str, Any] | None = None,
    **changes: Any,
) -> TrainedPolicy:
    """Load a trained policy.

    Args:
        source: id of a task, for the policy that the package ships; a run folder or one of its
            checkpoints; or a ``.safetensors`` file that ``ba-torchrl export`` wrote.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest".
        device: where it is computed.
        acting: other values of the algorithm's fields that do not affect learning: ``executed`` and
            ``steps`` of a policy of chunks.
        changes: further fields of `ExperimentConfig` to override.

    Returns:
        A TensorDict module that reads `in_keys` and writes ``action``. ``policy.make_env()`` makes
        its environment. A warning says if it was trained in another version of its task.

    Raises:
        ConfigError: there is no such policy, its files are damaged, or it names plugins that are
            neither imported nor installed.

    Examples:
        >>> from ba_torchrl import load_policy
        >>> policy = load_policy("close_loop/block_reaching")
        >>> env = policy.make_env(seed=0)
        >>> bool(env.rollout(100, policy)["next", "success"].any())
        True
        >>> env.close()
    """
    check_choice("which", which, Which)
    changes = {**_OF_TRAINING, "device": str(usable_device(device)), "acting": acting, **changes}
    if str(source) in TASKS:
        path = shipped_file(str(source))
        if not path.exists():
            raise ConfigError(
                f"the package ships no policy of {source}; `ba-torchrl leaderboard` lists those "
                "that it ships"
            )
    else:
        path = Path(expanded(source))
        if not path.exists():
            hint = f", and there is no run folder and no file {source}"
            raise UnknownNameError("policy", str(source), shipped_policies(), hint)
    if path.suffix != POLICY_SUFFIX or path.is_dir():
        checkpoint = find_checkpoint(path, which)
        config, learner = load(checkpoint, **changes)
        versions = read_versions(checkpoint.parent.parent)
        _warn_of_version(config.task, versions)
        return TrainedPolicy(learner, config, learner.updates, checkpoint, versions)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    result = read_result(path, data) if POLICY_RESULT in header_texts(path, data) else None
    known = result or _read_card(path)
    if known.policy_file != (_digest(data) if result else sha256(data).hexdigest()):
        raise DamagedFilesError(f"{path} was altered: it does not have the weights of its result")
    changes = {"run_dir": str(path.parent), "resume": False, **changes}
    config = parse_saved(known.config, path, **changes)
    learner = build_to_load(config, path, len(data))
    try:
        learner.policy.load_state_dict(load_tensors(data))
    except (RuntimeError, SafetensorError) as error:
        reason = textwrap.shorten(str(error), 300)
        raise ConfigError(f"{path} does not hold the policy of its result: {reason}") from None
    versions = Versions(known.task_version, known.expert_version)
    _warn_of_version(config.task, versions)
    return TrainedPolicy(learner, config, known.updates, path, versions, result)


def _digest(data: bytes) -> str:
    """Return the SHA-256 of the weights in a policy's file, which follow the header."""
    return sha256(data[8 + int.from_bytes(data[:8], "little") :]).hexdigest()


def _read_card(path: Path) -> _Card:
    """Read the card of a policy that an earlier version wrote as two files."""
    file = path.with_suffix(".json")
    try:
        card = _Card.model_validate_json(json_bytes(file))
    except (OSError, ValidationError):
        raise ConfigError(
            f"{path} holds weights without the result of their policy: write the policy of a run "
            "by `ba-torchrl export RUN`"
        ) from None
    logger.warning(
        "%s and %s are of an earlier version: `ba-torchrl export %s path=NEW.safetensors` tests "
        "the policy and writes one file",
        path,
        file.name,
        path,
    )
    return card


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


def check_version(policy: TrainedPolicy) -> None:
    """Raise `ConfigError` if a policy was trained in another version of its task."""
    here = versions_of(policy.task).task
    if policy.versions.task != here:
        raise ConfigError(
            f"the policy was trained in version {policy.versions.task} of {policy.task}, and its "
            f"episodes are of version {here}: train it again"
        )


def save_policy(policy: TrainedPolicy, path: str | Path, test: PolicyTest) -> RunResult:
    """Write a policy and the result of its test into one file. Weights are in half precision.

    Args:
        policy: after `round_weights`, or from such a file.
        path: ends in ``.safetensors``; an older file is replaced when the new one is complete.
        test: of this very policy, under the protocol, on this machine.

    Raises:
        OSError: there is not enough space, or the file cannot be written.
    """
    path = Path(path)
    tensors = {
        name: value.detach().to("cpu", torch.half if value.is_floating_point() else None, copy=True)
        for name, value in policy.policy.state_dict().items()
    }
    result = _result(policy, test, _digest(save_tensors(tensors)))
    data = save_tensors(tensors, {POLICY_RESULT: result.model_dump_json()})
    with errors_naming(path), atomic_file(path) as scratch:
        scratch.write_bytes(data)
    return result


def _result(policy: TrainedPolicy, test: PolicyTest, digest: str) -> RunResult:
    """Return the result of the test of a policy on this machine."""
    config, known, run = policy.config, policy.result, policy.source.parent.parent
    trained_on = known and known.trained_on
    if policy.source.is_dir() and (run / RESULT_FILE).exists():
        known = read_result(run)
        trained_on = Machine(hardware=known.hardware, versions=known.versions)
    of_machine = NON_LEARNING_FIELDS - _OF_POLICY
    settings = {name: value for name, value in config.resolved().items() if name not in of_machine}
    for name in ("demonstrations_path", "demonstrations_mapping"):
        settings[name] = settings[name] and Path(settings[name]).name
    return RunResult(
        protocol=PROTOCOL,
        task=policy.task,
        task_version=versions_of(policy.task).task,
        expert_version=known.expert_version if known else policy.versions.expert,
        label=config.label,
        benchmark=config.benchmark,
        seed=config.seed,
        curve=[],
        last=test,
        best=test,
        policy_file=digest,
        trained_on=trained_on,
        **{name: getattr(known, name, None) for name in _COUNTS},
        precision=precision(config),
        parameters=count_parameters(policy.policy),
        config=settings,
        versions=versions(),
        hardware=hardware(config.torch_device),
        phase_seconds={},
        finished=now(),
        files={},
    )


def evaluate_command(source: str | Path, result: RunResult) -> str:
    """Return the command that plays the test of a policy again.

    Args:
        source: the policy's file, or the task whose policy it is that the package ships.
        result: of the policy.
    """
    words = [f"policy={source}", f"episodes={result.last.episodes}"]
    if plugins := result.config.get("plugins"):
        words.append(f"plugins=[{','.join(plugins)}]")
    return shlex.join(["ba-torchrl", "evaluate", *words])
