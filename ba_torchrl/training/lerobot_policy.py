"""Policies that LeRobot trained on exported demonstrations, in our environments and tests."""

from __future__ import annotations

import copy
import importlib
import itertools
import json
import zlib
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from ba_torchrl.core import keys
from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import (
    ConfigError,
    MissingPackageError,
    in_one_line,
    install_command,
)
from ba_torchrl.core.files import json_bytes
from ba_torchrl.core.hardware import hardware, usable_device
from ba_torchrl.demonstrations.formats.base import Card, read_card
from ba_torchrl.envs.description import describe
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.lerobot import IMAGES, PolicyView
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.results import PolicyTest, RunResult, now, versions
from ba_torchrl.tasks.base import versions_of
from ba_torchrl.training.policy import EnvPolicy
from ba_torchrl.training.protocol import PROTOCOL, count_parameters

_ENV_TYPE = "ba_torchrl"
_WEIGHTS, _CONFIG, _TRAINING = "model.safetensors", "config.json", "train_config.json"
_PLACES = (".", "pretrained_model", "checkpoints/last/pretrained_model")
_ROW = (keys.CARRIED, "lerobot_row")
_MOST_ROWS = 256
"""Environments whose queues of actions are kept."""


class _Training:
    """What a checkpoint's folder says of its training."""

    def __init__(self, folder: Path) -> None:
        file = folder / _TRAINING
        try:
            values = json.loads(json_bytes(file))
            data, env = values["dataset"]["root"], values.get("env") or {}
        except FileNotFoundError:
            raise ConfigError(f"{file} is missing: it names the data set of the training") from None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"{file} is damaged: {error}") from None
        self.values = values
        place = folder.resolve().parent.name
        self.updates = int(place) if place.isdigit() else int(values.get("steps", 0))
        self.seed = int(values.get("seed") or 0)
        self.card: Card | None = read_card(Path(expanded(data))) if data else None
        if self.card is not None:
            self.resolved_env, self.cameras = self.card.resolved_env, self.card.cameras
            entries = self.card.entries.items()
            self.observed = [key for key, entry in entries if entry.role == "observation"]
        elif env.get("type") == _ENV_TYPE:
            parameters, plugins = env.get("parameters") or {}, env.get("plugins") or ()
            self.resolved_env = resolve_env(env["task"], parameters, modules=plugins)
            self.cameras, self.observed = env.get("cameras"), None
        else:
            raise ConfigError(
                f"{file}: dataset.root names {data}, which is no export of `ba-torchrl convert`; "
                "write the folder of the export there"
            )


class LeRobotPolicy(EnvPolicy):
    """A policy of LeRobot that acts in environments of TorchRL, greedily.

    Each environment has its own queue of actions: pass what the policy writes under ``carried`` on
    to the next step, as TorchRL's rollouts and collectors do. Rows are computed one by one, and
    noise is drawn from a seed that the observation gives, so that neither depends on other rows.

    Args:
        policy: LeRobot's policy.
        before: its preprocessor.
        after: its postprocessor.
        trained: what the folder says of its training.
        source: the folder.
    """

    def __init__(
        self, policy: Any, before: Any, after: Any, trained: _Training, source: Path
    ) -> None:
        super().__init__()
        self.policy = policy.requires_grad_(False)
        self._before, self._after = before, after
        self.trained, self.source, self.updates = trained, source, trained.updates
        self.resolved_env, self.result = trained.resolved_env.without_window(), None
        with closing(make(self.resolved_env)) as env:
            self.view = PolicyView(env, trained.observed, trained.cameras)
            specs = env.observation_spec
        self._check_inputs()
        read = [key for key in self.view.keys if key in specs]
        self.shapes = {key: tuple(specs[key].shape) for key in read}
        self.in_keys, self.out_keys = [*read, keys.STEP_COUNT], [keys.ACTION, _ROW]
        self._prompt = describe(self.task).instruction
        self._numbers = itertools.count()
        self._rows: dict[int, Any] = {}
        self.eval()

    def _check_inputs(self) -> None:
        """Check that the checkpoint reads what its environment observes, and gives its actions."""
        wanted = {**self.policy.config.input_features, **self.policy.config.output_features}
        here = self.view.features
        for name, feature in wanted.items():
            shape = here[name]["shape"] if name in here else None
            if shape != tuple(feature.shape):
                found = "does not have it" if shape is None else f"has {list(shape)}"
                raise ConfigError(
                    f"{self.source} reads or writes {name} of shape {list(feature.shape)}, and "
                    f"{self.task} with the parameters of its training {found}: the checkpoint is "
                    "of another task, size or choice of cameras"
                )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and the number of the queue that it is from.

        Raises:
            ConfigError: the observation lacks an entry that the policy reads, or its shape is
                another than in training.
        """
        observed = {key: tensordict[key] for key in self.shapes if key in tensordict}
        self._check_observed(self.shapes, {key: value.shape for key, value in observed.items()})
        shape = tensordict.batch_size
        arrays = {
            key: value.reshape(-1, *self.shapes[key]).cpu().numpy()
            for key, value in observed.items()
        }
        seen = self.view.read(arrays)
        counts = tensordict[keys.STEP_COUNT].reshape(-1).tolist()
        known = tensordict.get(_ROW, None)
        rows = [-1] * len(counts) if known is None else known.reshape(-1).tolist()
        texts = tensordict.get(keys.INSTRUCTION, None)
        prompts = [self._prompt] * len(counts) if texts is None else _flat(texts)
        actions: dict[int, torch.Tensor] = {}
        for i, (count, prompt) in enumerate(zip(counts, prompts, strict=True)):
            if rows[i] < 0:
                rows[i] = next(self._numbers)
            if rows[i] not in actions:  # a batch that is filled up repeats its last row
                one = {name: values[i] for name, values in seen.items()}
                actions[rows[i]] = self._act(rows[i], count == 0, one, prompt)
        device = tensordict.device or torch.device("cpu")
        chosen = torch.stack([actions[row] for row in rows]).to(device)
        tensordict.set(keys.ACTION, chosen.reshape(*shape, -1))
        numbers = torch.tensor(rows, device=device).reshape(*shape, 1)
        return tensordict.set(_ROW, numbers)

    def _act(
        self, row: int, is_first: bool, seen: Mapping[str, np.ndarray], prompt: str
    ) -> torch.Tensor:
        """Return the action [A] of an environment."""
        policy = self._rows.pop(row, None)
        if policy is None:  # its own queues, the same weights
            weights = itertools.chain(self.policy.parameters(), self.policy.buffers())
            policy = copy.deepcopy(self.policy, {id(each): each for each in weights})
            policy.reset()
        self._rows[row] = policy
        while len(self._rows) > _MOST_ROWS:
            del self._rows[next(iter(self._rows))]
        if is_first:
            policy.reset()
        batch: dict[str, Any] = {"task": [prompt]}
        seed = 0
        for name, values in seen.items():
            seed = zlib.crc32(np.ascontiguousarray(values).tobytes(), seed)
            tensor = torch.from_numpy(np.ascontiguousarray(values)).float()[None]
            batch[name] = tensor / 255 if name.startswith(IMAGES) else tensor
        device = torch.device(policy.config.device)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            action = self._after(policy.select_action(self._before(batch)))
        return action[0].float().cpu()

    def __repr__(self) -> str:
        return f"LeRobotPolicy({self.task}, {self.policy.config.type}, update {self.updates})"


def load_lerobot(folder: str | Path, device: str = "cpu") -> LeRobotPolicy:
    """Load a policy that LeRobot trained on an export of `ba-torchrl convert`.

    Args:
        folder: of a checkpoint, or the output folder of a training, whose last checkpoint is taken.
        device: where it is computed.

    Raises:
        ConfigError: there is no checkpoint, LeRobot cannot load it, its data set is not found, or
            it is of another task or size.
        MissingPackageError: LeRobot is not installed.
    """
    root = Path(expanded(folder))
    places = [root / place for place in _PLACES]
    found = next((place for place in places if (place / _CONFIG).is_file()), None)
    if found is None:
        raise ConfigError(f"no checkpoint of LeRobot at {root}: one has {_CONFIG} and {_WEIGHTS}")
    trained = _Training(found)
    try:
        factory = importlib.import_module("lerobot.policies.factory")
        configs = importlib.import_module("lerobot.configs.policies")
    except ImportError as error:
        raise MissingPackageError(
            f"a policy of LeRobot needs a package that is not installed ({error})",
            install_command("lerobot"),
        ) from error
    place = str(usable_device(device))
    try:
        config = configs.PreTrainedConfig.from_pretrained(found)
        config.device = place
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # the checkpoint has them
        policy = factory.get_policy_class(config.type).from_pretrained(found, config=config)
        before, after = factory.make_pre_post_processors(
            config,
            pretrained_path=str(found),
            preprocessor_overrides={"device_processor": {"device": place}},
        )
    except Exception as error:  # LeRobot raises anything at files that are damaged
        raise ConfigError(f"{found}: LeRobot cannot load it: {in_one_line(error)}") from error
    return LeRobotPolicy(policy, before, after, trained, found)


def result_of(policy: LeRobotPolicy, test: PolicyTest) -> RunResult:
    """Return the result of a test under the protocol, a row of the leaderboard."""
    card = policy.trained.card
    return RunResult(
        protocol=PROTOCOL,
        task=policy.task,
        task_version=versions_of(policy.task).task,
        expert_version=card.expert_version if card else None,
        label=f"LeRobot {policy.policy.config.type}",
        benchmark=None,
        seed=policy.trained.seed,
        curve=[],
        last=test,
        best=test,
        demonstrations=card.episodes if card else None,
        demonstration_steps=card.steps if card else None,
        env_steps=0,
        expert_labels=0,
        precision="float32",
        parameters=count_parameters(policy.policy),
        config={"env": policy.env_config, "lerobot": policy.trained.values},
        versions=versions(),
        hardware=hardware(torch.device(policy.policy.config.device)),
        seconds=None,
        phase_seconds={},
        finished=now(),
        files={},
    )


def _flat(texts: Any) -> list[str]:
    """Return the texts of a batch of any shape."""
    if isinstance(texts, str):
        return [texts]
    listed = texts.tolist() if hasattr(texts, "tolist") else texts
    parts = [listed] if isinstance(listed, str) else listed
    return [text for part in parts for text in _flat(part)]
