"""Every configuration that ships describes a run that can start."""

from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ba_torchrl.algorithms import base as registries
from ba_torchrl.config import parse
from ba_torchrl.errors import ConfigError
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.config import ExperimentConfig

CONFIGS = Path(__file__).parents[1] / "configs"
ALGORITHMS, NETWORKS = (
    sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
    for group in ("algorithm", "network")
)


def experiment(name, *overrides):
    hydra_schema.register()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        settings = compose(name, overrides=list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(settings)
    own = OmegaConf.masked_copy(settings, [key for key in settings if key != "hydra"])
    values = OmegaConf.to_container(own, resolve=True)
    return ExperimentConfig.parse(values)


TASK_OF = {"close_loop": "close_loop/block_picking", "open_loop": "open_loop/block_stacking"}


@cache
def names_of(group):
    """The registered name behind each preset of a group."""
    hydra_schema.register()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        presets = sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
        return {preset: compose(f"{group}/{preset}")[group].name for preset in presets}


def controls_of(algorithm):
    return registries.ALGORITHMS[names_of("algorithm")[algorithm]].controls


def control_of(network):
    return registries.NETWORKS[names_of("network")[network]].control


def suits(algorithm, network):
    return control_of(network) in controls_of(algorithm)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("network", NETWORKS)
def test_presets_compose_or_are_refused(algorithm, network):
    is_suited = suits(algorithm, network)
    control = control_of(network) if is_suited else min(controls_of(algorithm))
    task = TASK_OF[control]
    overrides = (f"task={task}", f"algorithm={algorithm}", f"network={network}", "seed=3")
    if not is_suited:
        with pytest.raises(ConfigError, match="network"):
            experiment("train", *overrides)
        return
    if algorithm.startswith("ferm"):
        with pytest.raises(ConfigError, match="pretrain_updates"):
            experiment("train", *overrides)
        overrides += ("pretrain_updates=1600",)
    config = experiment("train", *overrides)
    assert config.label == f"{algorithm} {network}"
    name = task.replace("/", "_")
    assert config.run_dir.endswith(f"{name}-{algorithm}_{network}-seed3")


def test_defaults_are_those_of_the_appendix_or_the_reference():
    config = experiment("train", "algorithm=sacfd_per")
    algorithm, network = config.algorithm_config, config.network_config
    assert (algorithm.learning_rate, algorithm.gamma, algorithm.batch_size) == (1e-3, 0.99, 64)
    assert (algorithm.alpha_init, algorithm.target_entropy, algorithm.tau) == (0.01, -5.0, 0.01)
    assert (algorithm.priority_exponent, algorithm.importance_exponent) == (0.6, 0.4)
    assert (algorithm.expert_bonus, algorithm.demonstration_weight) == (1.0, 1.0)
    assert algorithm.buffer_size == 100_000
    assert (network.group_order, network.n_hidden) == (8, 64)
    assert (config.num_envs, config.eval_every) == (5, 500)
    assert config.resolved_env.config.obs_size == 128


def options(algorithm):
    config = experiment("train", f"algorithm={algorithm}").algorithm_config
    return config.model_dump(exclude_defaults=True)


def test_the_variants_of_sac_differ_from_sacfd_by_their_options():
    rotation = {"augmentation": "so2"}
    assert options("sacfd") == {}
    assert options("sacfd_so2") == rotation
    assert options("sacfd_per") == {"replay": "prioritized"}
    assert options("sacfd_per_so2") == {"replay": "prioritized", **rotation}
    assert options("sac") == {"demonstration_weight": 0}
    assert options("sac_so2") == {"demonstration_weight": 0, **rotation}


def test_training_and_quick_start_have_priorities_and_rotation_by_default():
    for name in ("train", "quickstart"):
        config = experiment(name).algorithm_config
        assert (config.replay, config.augmentation) == ("prioritized", "so2")
        assert (config.expert_bonus, config.augmentation_probability) == (1.0, 0.8)
        assert config.importance_weighted == "critic_and_policy"


def test_open_loop_defaults_are_those_of_the_appendix_or_the_reference():
    overrides = ("task=open_loop/block_stacking", "algorithm=sdqfd", "network=equi_asr")
    config = experiment("train", *overrides)
    algorithm = config.algorithm_config
    assert (algorithm.learning_rate, algorithm.weight_decay) == (1e-4, 1e-5)
    assert (algorithm.gamma, algorithm.batch_size, algorithm.buffer_size) == (0.95, 16, 100_000)
    assert (algorithm.demonstrations, algorithm.replay) == ("sdqfd", "symmetric")
    assert (algorithm.demonstration_weight, algorithm.margin) == (0.1, 0.1)
    assert (algorithm.epsilon_init, algorithm.target_interval) == (0.0, 100)
    assert (config.resolved_env.config.obs_size, config.network_config.num_rotations) == (128, 16)
    assert experiment("train", *overrides[:1], "algorithm=adet", overrides[2]).algorithm_config == (
        algorithm.model_copy(update={"demonstrations": "adet", "demonstration_weight": 0.01})
    )


QUICK_STARTS = sorted(path.stem for path in CONFIGS.glob("quickstart*.yaml"))
OPEN_LOOP = {"quickstart_open_loop", "quickstart_six_dof"}


@pytest.mark.parametrize(
    ("name", "algorithm"),
    [
        (name, algorithm)
        for name in QUICK_STARTS
        for algorithm in ALGORITHMS
        if suits(algorithm, "asr" if name in OPEN_LOOP else "cnn")
    ],
)
def test_algorithms_have_their_own_values_in_every_quick_start(name, algorithm):
    """A preset without demonstrations does not get a behaviour term from the configuration."""
    overrides = [f"algorithm={algorithm}"]
    if algorithm.startswith("ferm"):
        overrides += ["network=ferm", "env.obs_size=142"]
    config = experiment(name, *overrides)
    assert config.label.startswith(f"{algorithm} ")
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        own = hydra_schema.preset("algorithm", algorithm)
    assert config.algorithm_config == parse(registries.ALGORITHMS[own.pop("name")], own, algorithm)


def test_the_open_loop_quick_start_composes():
    config = experiment("quickstart_open_loop", "seed=1")
    assert config.task == "open_loop/block_stacking"
    assert config.network_config.scene_head == "pool"
    assert config.resolved_env.config.num_objects == 3


def test_the_quick_start_for_stacking_composes():
    config = experiment("quickstart_stacking")
    assert config.task == "close_loop/block_stacking"
    assert config.resolved_env.config.obs_size == 128
    assert config.algorithm_config.imitate_successes
    assert config.algorithm_config.replay == "prioritized"


@pytest.mark.parametrize("network", ["asr", "equi_deictic_asr"])
def test_the_quick_start_in_six_degrees_of_freedom_composes(network):
    config = experiment("quickstart_six_dof", f"network={network}")
    assert config.task == "ramp/block_stacking"
    assert config.resolved_env.config.in_hand_mode == "proj"
    assert (config.network_config.voxel_scale, config.network_config.num_rotations) == (10, 8)


@pytest.mark.parametrize("name", ["quickstart", "quickstart_stacking"])
@pytest.mark.parametrize("network", [name for name in NETWORKS if suits("sacfd", name)])
def test_the_quick_starts_of_close_loop_take_any_network(name, network):
    config = experiment(name, f"network={network}", "env.max_steps=20")
    assert config.resolved_env.config.max_steps == 20
    assert (
        config.resolved_env.config.obs_size == {"quickstart": 64, "quickstart_stacking": 128}[name]
    )
