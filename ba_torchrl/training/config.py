"""ExperimentConfig: everything that determines a training run.

Its fields are known, and most of their values checked, without the import of torch, which takes
seconds; methods import what needs it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import (
    Field,
    SerializationInfo,
    ValidationInfo,
    field_serializer,
    field_validator,
)

from ba_torchrl.algorithms.config import ALGORITHMS, NETWORKS, LearnerConfig, NetworkConfig
from ba_torchrl.core.config import (
    RULES,
    Chosen,
    CompileMode,
    InnerError,
    LocalPath,
    Seed,
    Source,
    WorkerOptions,
    parse,
    without_replaced,
)
from ba_torchrl.core.errors import ConfigError, PartError, install_command
from ba_torchrl.core.plugins import MAIN, load_plugins
from ba_torchrl.core.seeds import SeedUse, derive_seed
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.record.logging import Backend
from ba_torchrl.training.collectors.config import COLLECTORS, CollectorConfig

if TYPE_CHECKING:
    import torch

SET_BY_THE_EXPERIMENT = ("seed", "expert", "expert_chunk")
"""Fields of `EnvConfig` that are not for the user to set."""


class ExperimentConfig(WorkerOptions):
    """One training run, by default as in the close-loop benchmarks (appendix G.2).

    Where the appendix gives no value, the default is from the reference implementation, and the
    field says so. `parse` checks all fields, nested ones included, before anything starts.
    """

    plugins: list[str] = Field(default_factory=list)
    """Modules outside the package to import first. `parse` adds those that register the run's task,
    robot, network, algorithm and collector."""
    task: str
    """Id of the task."""
    env: ResolvedEnv = Field(default={}, validate_default=True)
    """Parameters of the task's environment, fields of `EnvConfig`."""
    algorithm: Annotated[LearnerConfig, Chosen(ALGORITHMS)]
    """``name`` of a registered algorithm and its hyper-parameters."""
    network: Annotated[NetworkConfig, Chosen(NETWORKS)]
    """``name`` of a registered network and its hyper-parameters."""
    seed: Seed = 0
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
    compiler of the system, and minutes at the first update; random draws differ from a
    run's that is not compiled."""
    num_envs: int = Field(default=5, ge=1, le=1024)
    """Number of environments that step together."""
    parallel: bool | None = None
    """One process per environment, or all in this process, with the same episodes; None for
    processes where at least three can run at a time."""
    wait_for_restarts: bool = False
    """In collection; evaluations wait. See `WorkerOptions` for the fields of processes."""
    collector: Annotated[CollectorConfig, Chosen(COLLECTORS)] = Field(
        default={"name": "single"}, validate_default=True
    )
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
    """Updates between evaluations of the greedy policy. The first evaluates the untrained policy;
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
    """Updates between rows of the losses; a shorter run has one row, for its last update."""
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

    @property
    def workers(self) -> WorkerOptions:
        """How the processes of environments start and are replaced."""
        names = WorkerOptions.model_fields
        return WorkerOptions.model_construct(**{name: getattr(self, name) for name in names})

    def derived_seed(self, use: SeedUse, part: int = 0) -> int:
        """Return the first seed of the environments that serve ``use``.

        Args:
            use: what the environments serve.
            part: number of a further set of episodes for the same use, after a resumption.
        """
        return derive_seed(self.seed, use, part)

    def resolved(self) -> dict[str, Any]:
        """Return what determines the run as JSON: every default of the task filled in, without the
        resources of the collector and the window."""
        values, unset = self.model_dump(mode="json"), {*SET_BY_THE_EXPERIMENT, "render"}
        for name in self.collector.resources:
            values["collector"].pop(name, None)
        return {**values, "env": self.env.config.model_dump(mode="json", exclude=unset)}

    @property
    def torch_device(self) -> torch.device:
        """The learner's device."""
        from ba_torchrl.core.hardware import as_device

        return as_device(self.device)

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
        config = parse(cls, _without_replaced(values, given), what)
        config.collector.check(config.num_envs)
        if config.env.config.obs_type != "pixel":
            raise ConfigError("env.obs_type: the networks take images; leave it at 'pixel'")
        algorithm = config.algorithm
        algorithm.check(config.network, config.env.task_class.control)
        config._check_reward()
        own, further = algorithm.first_updates, config.pretrain_updates
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
        if not algorithm.collects and not config.demonstrations:
            why = "learns from demonstrations only; set demonstrations"
            raise PartError("algorithm", ALGORITHMS.name_of(type(algorithm)), why)
        capacity = algorithm.replay.capacity
        if config.min_replay > capacity:
            raise ConfigError(
                f"min_replay: {config.min_replay} transitions are more than the replay holds "
                f"({capacity}); the run would never start to learn"
            )
        if config.compile_mode is not None and not algorithm.is_compilable:
            why = "cannot be compiled; leave out compile_mode"
            raise PartError("algorithm", ALGORITHMS.name_of(type(algorithm)), why)
        config._check_demonstrations()
        if config.logger != "csv" and find_spec(config.logger) is None:
            raise ConfigError(
                f"logger: {config.logger!r} needs a package that is not installed: "
                + install_command(config.logger)
            )
        from ba_torchrl.core.hardware import usable_device

        usable_device(config.device)
        return config.model_copy(update={"plugins": config._all_plugins()})

    @field_validator("plugins")
    @classmethod
    def _load(cls, names: list[str]) -> list[str]:
        try:
            load_plugins(names)
        except ConfigError as error:
            raise InnerError(error) from error
        return names

    @field_validator("env", mode="plain")
    @classmethod
    def _resolve(cls, values: Any, info: ValidationInfo) -> ResolvedEnv | None:
        if not isinstance(values, Mapping):
            raise ValueError(RULES["dict_type"].format())
        if "task" not in info.data:
            return None  # the task's error is the one to report
        try:
            for reserved in SET_BY_THE_EXPERIMENT:
                if reserved in values:
                    raise ConfigError(f"env.{reserved} is set by the experiment; leave it out")
            return resolve_env(info.data["task"], values, "env", info.data.get("plugins", ()))
        except ConfigError as error:
            raise InnerError(error) from error

    @field_serializer("env")
    def _given(self, env: ResolvedEnv, info: SerializationInfo) -> dict[str, Any]:
        return env.config.model_dump(mode=info.mode, exclude_unset=True)

    def __reduce__(self) -> tuple[Any, ...]:
        return _blank, (type(self), self.plugins), self.__getstate__()

    def _all_plugins(self) -> list[str]:
        """Return `plugins` and the modules that register what the run uses, each once."""
        modules = (
            registry.plugin_module(registry.name_of(type(getattr(self, kind))))
            for kind, registry in _REGISTRIES.items()
        )
        found = [name for name in modules if name is not None and name not in MAIN]
        return list(dict.fromkeys([*self.env.modules, *found]))

    def _check_reward(self) -> None:
        env, gamma = self.env.config, getattr(self.algorithm, "gamma", None)
        if env.reward == "difference" and gamma not in (None, env.reward_discount):
            raise ConfigError(
                f"env.reward_discount: {env.reward_discount:g} must equal algorithm.gamma, "
                f"{gamma:g}; otherwise the difference changes which policy is optimal"
            )
        if env.reward == "dense" and not getattr(self.algorithm, "bootstrap_truncated", True):
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
            self.env.actions.turns,
            "demonstrations_turn_noise",
        )
        if self.demonstrations and self.demonstrations_source == "deconstruction":
            from ba_torchrl.tasks.structures.open_loop import check_has_structure

            check_has_structure(self.task)
        if self.demonstrations_path is not None:
            if not self.demonstrations:
                raise ConfigError("demonstrations_path: set demonstrations, the number of episodes")
            check_demonstrations(
                self.demonstrations_path,
                task=self.task,
                env=self.env.given,
                least=self.demonstrations,
                mapping=self.demonstrations_mapping,
            )
        elif self.demonstrations_mapping is not None:
            raise ConfigError("demonstrations_mapping is for demonstrations_path; set both")


def _blank(model: type[ExperimentConfig], plugins: Collection[str]) -> ExperimentConfig:
    """Import plugins, and return what gets its fields from a pickle."""
    load_plugins(plugins)
    return model.__new__(model)


_REGISTRIES = {"network": NETWORKS, "algorithm": ALGORITHMS, "collector": COLLECTORS}
"""Registry of each field that is chosen from one."""


def _without_replaced(values: Mapping[str, Any], given: Collection[str]) -> dict[str, Any]:
    """Return values without the parts that given values replace."""
    out = dict(values)
    for kind, registry in _REGISTRIES.items():
        below = [name.removeprefix(f"{kind}.") for name in given if name.startswith(f"{kind}.")]
        name = out[kind].get("name") if below and isinstance(out.get(kind), Mapping) else None
        if name is not None and name in registry:
            out[kind] = without_replaced(registry[name], out[kind], below)
    return out
