"""ExperimentConfig: everything that determines a training run.

Its fields are known, and most of their values checked, without the import of torch, which takes
seconds; methods import what needs it.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from ba_torchrl.core.config import (
    MAX_SEED,
    CompileMode,
    LocalPath,
    Source,
    WorkerOptions,
    parse,
    without_replaced,
)
from ba_torchrl.core.errors import ConfigError, PartError, install_command
from ba_torchrl.core.plugins import MAIN, load_plugins
from ba_torchrl.envs.settings import ResolvedEnv, check_env, resolve_env
from ba_torchrl.record.logging import Backend
from ba_torchrl.tasks.structures.open_loop import check_has_structure

if TYPE_CHECKING:
    import torch

    from ba_torchrl.algorithms.base import LearnerConfig, NetworkConfig, SeedUse
    from ba_torchrl.training.collectors.base import CollectorConfig

SET_BY_THE_EXPERIMENT = ("seed", "expert")
"""Fields of `EnvConfig` that are not for the user to set."""


class ExperimentConfig(WorkerOptions):
    """One training run. The defaults are those of the close-loop benchmarks (appendix G.2).

    Where the appendix gives no value, the default is that of the reference implementation, and the
    field says so. `parse` checks all fields, nested ones included, before anything starts.
    """

    plugins: list[str] = Field(default_factory=list)
    """Modules outside the package to import first. `parse` adds those that register the run's task,
    robot, network, algorithm and collector."""
    task: str
    """Id of the task."""
    env: dict[str, Any] = Field(default_factory=dict)
    """Fields of `EnvConfig`."""
    algorithm: dict[str, Any]
    """``name`` of a registered algorithm and its hyper-parameters."""
    network: dict[str, Any]
    """``name`` of a registered network and its hyper-parameters."""
    seed: int = Field(default=0, ge=0, le=MAX_SEED)
    """Seed of networks, environments, replay and augmentation."""
    device: str = "auto"
    """Where the learner runs; "auto" takes a GPU if there is one."""
    threads: int | None = Field(default=None, ge=1, le=1024)
    """torch threads of the learner; None leaves torch's choice."""
    tf32: bool | None = None
    """TensorFloat-32 in float32 convolutions and matrix products of a GPU; None leaves torch's
    choice, which is convolutions only."""
    compile_mode: CompileMode | None = None
    """Mode of `torch.compile` for the loss and its gradient; None does not compile them. Needs a
    compiler of the system, and minutes at the first update; random draws differ from those of a
    run that is not compiled."""
    num_envs: int = Field(default=5, ge=1, le=1024)
    """Number of environments that step together."""
    parallel: bool | None = None
    """One process per environment, or all in this process, with the same episodes; None for
    processes where at least three can run at a time."""
    wait_for_restarts: bool = False
    """In collection; evaluations wait. See `WorkerOptions` for the fields of processes."""
    collector: dict[str, Any] = Field(default_factory=lambda: {"name": "single"})
    """``name`` of a registered collector and its options: where the policy collects."""
    demonstrations: int = Field(default=100, ge=0)
    """Expert episodes in the replay before the first update; reference implementation."""
    demonstrations_source: Source = "expert"
    """Their source: "expert", or "deconstruction" of structures, reversed in time."""
    only_successful_demonstrations: bool = False
    """Whether other episodes replace failed ones, as in the reference implementation in open loop;
    in close loop it keeps failed ones."""
    demonstrations_noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random action in place of the expert's in each step of a demonstration that
    is played for the run (Laskey et al., 2017). The expert recovers. In these steps, the
    behaviour term of SAC, behaviour cloning and DAgger imitate the action that it would have
    executed. To spatial Q-learning with a term on demonstrations, they are no demonstrations; RLPD,
    IQL and DQN take them as they are. None in the appendix."""
    demonstrations_turn_noise: float = Field(default=0.0, ge=0, lt=1)
    """Probability of a random turn beside the expert's other components, likewise. An expert turns
    the gripper at the beginning of a motion, so that its later steps have no wrong yaw, in which a
    policy that has not learnt to turn arrives. None in the appendix."""
    demonstrations_path: LocalPath | None = None
    """Folder that `ba-torchrl collect` wrote, or demonstrations in the format of LeRobot, Minari,
    robomimic or Diffusion Policy. They replace newly collected ones, and source and noise are
    theirs."""
    demonstrations_mapping: LocalPath | None = None
    """YAML file with the names of the entries in somebody else's demonstrations (docs/data.md)."""
    pretrain_updates: int = Field(default=0, ge=0)
    """Updates on the demonstrations before the first environment step, besides the first ones of
    parts of the algorithm, such as ``algorithm.init.updates``. If they equal ``total_updates``, the
    run has no environment steps, and those first ones are among them."""
    total_updates: int = Field(default=10_000, ge=1)
    """Gradient updates of the run, pretraining included; reference implementation."""
    updates_per_step: int = Field(default=1, ge=1)
    """Updates for each step of all environments together; reference implementation."""
    min_replay: int = Field(default=100, ge=1)
    """Transitions in the replay before the first update; reference implementation."""
    eval_every: int = Field(default=500, ge=1)
    """Updates between evaluations of the greedy policy, the first of which is of the untrained one;
    a checkpoint follows each later one, and the best and the latest ones are kept."""
    eval_episodes: int = Field(default=100, ge=1)
    """Episodes of each of these evaluations; reference implementation."""
    stop_at_success: float | None = Field(default=None, gt=0, le=1)
    """Success rate that ends the run when two evaluations in a row reach it; None for all updates.
    If it is set, every evaluation has other episodes."""
    final_eval_episodes: int = Field(default=500, ge=1)
    """Episodes of the test at the end, of the last policy and, beside it, of the checkpoint with
    the best evaluation; see docs/protocol.md. A number with fewer than 200 cannot be cited."""
    save_minutes: float = Field(default=10.0, gt=0)
    """Minutes after which the state for ``resume`` is saved, besides at every evaluation."""
    log_every: int = Field(default=50, ge=1)
    """Updates between rows of the losses; a shorter run has one row, that of its last update."""
    logger: Backend = "csv"
    """Logger of scalars in addition to the run folder's CSV file."""
    video_episodes: int = Field(default=3, ge=0)
    """Greedy episodes in the video at the end."""
    label: str = "run"
    """Name of the curve in plots, such as "sacfd equi"."""
    run_dir: LocalPath = "runs/run"
    """Folder of the run's files."""
    resume: bool = False
    """Continue the run in that folder if it was interrupted."""
    benchmark: str | None = None
    """Name of the benchmark that the run belongs to, for reports."""

    @cached_property
    def resolved_env(self) -> ResolvedEnv:
        """The environments' task and parameters."""
        return resolve_env(self.task, self.env, "env", self.plugins)

    @property
    def workers(self) -> WorkerOptions:
        """How the processes of environments start and are replaced."""
        return WorkerOptions(**{name: getattr(self, name) for name in WorkerOptions.model_fields})

    @cached_property
    def network_config(self) -> NetworkConfig:
        """The network's hyper-parameters."""
        from ba_torchrl.algorithms.base import NETWORKS

        return choose(NETWORKS, self.network, "network")

    @cached_property
    def algorithm_config(self) -> LearnerConfig:
        """The algorithm's hyper-parameters."""
        from ba_torchrl.algorithms.base import ALGORITHMS

        return choose(ALGORITHMS, self.algorithm, "algorithm")

    @cached_property
    def collector_config(self) -> CollectorConfig:
        """The collector's options."""
        from ba_torchrl.training.collectors.base import COLLECTORS

        return choose(COLLECTORS, self.collector, "collector")

    def derived_seed(self, use: SeedUse, part: int = 0) -> int:
        """Return the first seed of the environments that serve ``use``.

        Args:
            use: what the environments serve.
            part: number of a further set of episodes for the same use, after a resumption.
        """
        from ba_torchrl.algorithms.base import derive_seed

        return derive_seed(self.seed, use, part)

    def resolved(self) -> dict[str, Any]:
        """Return the configuration as JSON, every default filled in."""
        return {
            **self.model_dump(mode="json"),
            "env": self.resolved_env.config.model_dump(
                mode="json", exclude=set(SET_BY_THE_EXPERIMENT)
            ),
            "algorithm": {
                "name": self.algorithm["name"],
                **self.algorithm_config.model_dump(mode="json"),
            },
            "network": {
                "name": self.network["name"],
                **self.network_config.model_dump(mode="json"),
            },
            "collector": {
                "name": self.collector["name"],
                **self.collector_config.model_dump(
                    mode="json", exclude=set(self.collector_config.resources)
                ),
            },
        }

    @property
    def torch_device(self) -> torch.device:
        """The learner's device."""
        return _as_device(self.device)

    @property
    def folder(self) -> Path:
        """The run folder."""
        return Path(self.run_dir)

    @classmethod
    def parse(
        cls, values: dict[str, Any], what: str = "experiment", given: Collection[str] = ()
    ) -> ExperimentConfig:
        """Validate ``values``, nested parts included.

        Args:
            values: of the fields.
            what: is configured, for error messages.
            given: dotted names of the values that override presets; see `without_replaced`.

        Raises:
            ConfigError: a name is unknown, a type wrong, or parts do not go together.
        """
        config = cls.check_fields(values, what)._without_replaced(given)
        if config.resolved_env.config.obs_type != "pixel":
            raise ConfigError("env.obs_type: the networks take images; leave it at 'pixel'")
        control = config.resolved_env.task_class.control
        config.algorithm_config.check(config.network_config, control)
        config._check_reward()
        own, further = config.algorithm_config.first_updates, config.pretrain_updates
        total = config.total_updates
        offline = max(own, total) if further == total else own + further
        if offline > total:
            others = f"{own} first updates of the algorithm and " if own else ""
            raise ConfigError(
                f"{others}pretrain_updates ({further}) are part of total_updates ({total}) and "
                "cannot exceed it"
            )
        if offline and not config.demonstrations:
            raise ConfigError("an update before the first environment step needs demonstrations")
        if not config.algorithm_config.collects and not config.demonstrations:
            why = "learns from demonstrations only; set demonstrations"
            raise PartError("algorithm", config.algorithm["name"], why)
        capacity = config.algorithm_config.replay.capacity
        if config.min_replay > capacity:
            raise ConfigError(
                f"min_replay: {config.min_replay} transitions are more than the replay holds "
                f"({capacity}); the run would never start to learn"
            )
        config.collector_config.check(config.num_envs)
        if config.compile_mode is not None and not config.algorithm_config.is_compilable:
            why = "cannot be compiled; leave out compile_mode"
            raise PartError("algorithm", config.algorithm["name"], why)
        config._check_demonstrations()
        if config.logger != "csv" and find_spec(config.logger) is None:
            raise ConfigError(
                f"logger: {config.logger!r} needs a package that is not installed: "
                + install_command(config.logger)
            )
        usable_device(config.device)
        return config.model_copy(update={"plugins": config._all_plugins()})

    @classmethod
    def check_fields(cls, values: dict[str, Any], what: str = "experiment") -> ExperimentConfig:
        """Validate everything that needs no torch: the fields, and those of the environment."""
        config = parse(cls, values, what)
        load_plugins(config.plugins)
        for reserved in SET_BY_THE_EXPERIMENT:
            if reserved in config.env:
                raise ConfigError(f"env.{reserved} is set by the experiment; leave it out")
        check_env(config.task, config.env, "env")
        return config

    def _without_replaced(self, given: Collection[str]) -> ExperimentConfig:
        changes = {}
        for kind, registry in _registries().items():
            values = getattr(self, kind)
            below = [name.removeprefix(f"{kind}.") for name in given if name.startswith(f"{kind}.")]
            if below and "name" in values:
                changes[kind] = without_replaced(registry[values["name"]], values, below)
        return self.model_copy(update=changes)

    def _all_plugins(self) -> list[str]:
        """Return `plugins` and the modules that register what the run uses, each once."""
        modules = (
            registry.plugin_module(getattr(self, kind)["name"])
            for kind, registry in _registries().items()
        )
        found = [name for name in modules if name is not None and name not in MAIN]
        return list(dict.fromkeys([*self.resolved_env.modules, *found]))

    def _check_reward(self) -> None:
        env, gamma = self.resolved_env.config, getattr(self.algorithm_config, "gamma", None)
        if env.reward == "difference" and gamma not in (None, env.reward_discount):
            raise ConfigError(
                f"env.reward_discount: {env.reward_discount:g} must equal algorithm.gamma, "
                f"{gamma:g}; otherwise the difference changes which policy is optimal"
            )
        if env.reward == "dense" and not getattr(
            self.algorithm_config, "bootstrap_truncated", True
        ):
            raise ConfigError(
                "env.reward: with 'dense', success is truncated and needs "
                "algorithm.bootstrap_truncated=true"
            )

    def _check_demonstrations(self) -> None:
        from ba_torchrl.demonstrations.collect import check_noise, check_turn_noise
        from ba_torchrl.demonstrations.demo_files import check_demonstrations

        check_noise(self.demonstrations_noise, self.demonstrations_source, "demonstrations_noise")
        check_turn_noise(
            self.demonstrations_turn_noise,
            self.demonstrations_source,
            self.resolved_env.actions.turns,
            "demonstrations_turn_noise",
        )
        if self.demonstrations and self.demonstrations_source == "deconstruction":
            check_has_structure(self.task)
        if self.demonstrations_path is not None:
            if not self.demonstrations:
                raise ConfigError("demonstrations_path: set demonstrations, the number of episodes")
            check_demonstrations(
                self.demonstrations_path,
                task=self.task,
                env=self.env,
                least=self.demonstrations,
                mapping=self.demonstrations_mapping,
            )
        elif self.demonstrations_mapping is not None:
            raise ConfigError("demonstrations_mapping: set demonstrations_path, whose it is")


def usable_device(name: str) -> torch.device:
    """Return a device that can compute, named as in torch; "auto" for a GPU if there is one, else
    the CPU. `ConfigError` if it does not exist."""
    import torch

    try:
        device = _as_device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"device: use device=cpu or device=auto ({reason})") from None
    return device


def _as_device(name: str) -> torch.device:
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)


def _registries() -> dict[str, Any]:
    """Return the registry of each field that is chosen from one."""
    from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
    from ba_torchrl.training.collectors.base import COLLECTORS

    return {"network": NETWORKS, "algorithm": ALGORITHMS, "collector": COLLECTORS}


def choose(registry: Any, values: dict[str, Any], kind: str) -> Any:
    """Return the registered configuration class called ``values["name"]``, filled in.

    ``kind`` says what is chosen, for the `ConfigError` of unknown names and values.
    """
    rest = dict(values)
    name = rest.pop("name", None)
    if name is None:
        raise ConfigError(f"{kind}.name is missing; known: {', '.join(registry)}")
    return parse(registry[name], rest, kind, name=name)
