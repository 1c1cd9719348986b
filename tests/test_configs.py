"""Every configuration that ships describes a run that can start."""

from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ba_torchrl.algorithms import base as registries
from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
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
def presets(group):
    """The values of each preset of a group."""
    hydra_schema.register()
    names = sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return {name: hydra_schema.preset(group, name) for name in names}


def controls_of(algorithm):
    return registries.ALGORITHMS[presets("algorithm")[algorithm]["name"]].controls


def networks_for(control):
    values = presets("network").items()
    return [name for name, own in values if registries.NETWORKS[own["name"]].control == control]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_composes_with_a_network_of_its_control_only(algorithm):
    for control in sorted(controls_of(algorithm)):
        overrides = [f"task={TASK_OF[control]}", f"algorithm={algorithm}", "seed=3"]
        if algorithm == "ferm":
            with pytest.raises(ConfigError, match="pretrain_updates"):
                experiment("train", *overrides)
            overrides.append("pretrain_updates=1600")
        network = networks_for(control)[0]
        other = networks_for({"close_loop": "open_loop", "open_loop": "close_loop"}[control])[0]
        with pytest.raises(ConfigError, match="network"):
            experiment("train", *overrides, f"network={other}")
        config = experiment("train", *overrides, f"network={network}")
        method = "sacfd_per_so2" if algorithm == "sacfd" else algorithm
        assert config.label == f"{method} {network}"
        name = TASK_OF[control].replace("/", "_")
        assert config.run_dir.endswith(f"{name}-{method}_{network}-seed3")


@pytest.mark.parametrize("network", NETWORKS)
def test_every_network_composes(network):
    control = presets("network")[network]["name"]
    control = registries.NETWORKS[control].control
    algorithm = {"close_loop": "sac", "open_loop": "dqn"}[control]
    overrides = (f"task={TASK_OF[control]}", f"algorithm={algorithm}", f"network={network}")
    assert experiment("train", *overrides).label == f"{algorithm} {network}"


def method(name):
    hydra_schema.register()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        values = hydra_schema.preset("algorithm", name)
    return parse(registries.ALGORITHMS[values.pop("name")], values, name)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("sacfd", {}),
        ("sac", {"demonstration_weight": 0}),
        ("sac_so2", {"demonstration_weight": 0, "augmentation": "so2"}),
        ("sacfd_per_so2", {"replay": "prioritized", "augmentation": "so2"}),
        ("rad", {"view_transform": "shift", "shift_pixels": 7}),
        ("rad_sac", {"view_transform": "shift", "shift_pixels": 7, "demonstration_weight": 0}),
        ("rad_sacfd_so2", {"view_transform": "shift", "shift_pixels": 7, "augmentation": "so2"}),
        (
            "drq_per",
            {"view_transform": "shift", "views": 2, "target_views": 2, "replay": "prioritized"},
        ),
        ("rlpd_so2", {"augmentation": "so2"}),
        ("sdqfd_per", {"replay": "prioritized"}),
    ],
)
def test_a_method_is_an_algorithm_a_replay_and_a_rotation(name, options):
    assert method(name).model_dump(exclude_defaults=True) == options
    parts = name.split("_")
    groups = {"algorithm": parts[0], "replay": "uniform", "rotation": "none"}
    groups |= {"replay": "per"} if "per" in parts else {}
    groups |= {"rotation": "so2"} if "so2" in parts else {}
    lines = [f"{group}={value}" for group, value in groups.items()]
    lines += ["algorithm.demonstration_weight=0"] if "sac" in parts[1:] else []
    if parts[0] == "sdqfd":
        lines += ["task=open_loop/block_stacking", "network=asr"]
    assert experiment("train", *lines).algorithm_config == method(name)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bc_per", "replay: Input should be 'uniform'"),
        ("rlpd_per", "replay: Input should be 'symmetric'"),
        ("iql_so2", "unknown parameter 'augmentation'"),
        ("sdqfd_so2", "augmentation: Input should be"),
        ("sacfd_so2_per", "unknown algorithm 'sacfd_so2_per'.*Known: .*sacfd"),
        ("sacfd_", "unknown algorithm 'sacfd_'"),
        ("sacdf", "Did you mean 'sacfd'"),
    ],
)
def test_methods_that_do_not_exist_are_refused(name, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        method(name)


def test_defaults_are_those_of_the_appendix_or_the_reference():
    config = experiment("train", "rotation=none")
    algorithm, network = config.algorithm_config, config.network_config
    assert (algorithm.learning_rate, algorithm.gamma, algorithm.batch_size) == (1e-3, 0.99, 64)
    assert (algorithm.alpha_init, algorithm.target_entropy, algorithm.tau) == (0.01, -5.0, 0.01)
    assert (algorithm.priority_exponent, algorithm.importance_exponent) == (0.6, 0.4)
    assert (algorithm.expert_bonus, algorithm.demonstration_weight) == (1.0, 1.0)
    assert algorithm.buffer_size == 100_000
    assert (network.group_order, network.n_hidden) == (8, 64)
    assert (config.num_envs, config.eval_every) == (5, 500)
    assert config.resolved_env.config.obs_size == 128


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


@pytest.mark.parametrize("name", sorted(path.stem for path in CONFIGS.glob("quickstart*.yaml")))
def test_other_algorithms_have_their_own_values_in_every_quick_start(name):
    """The values of a quick start are those of its algorithm: sac gets no behaviour term."""
    is_open_loop = name in ("quickstart_open_loop", "quickstart_six_dof")
    for algorithm in ("dqn", "bc") if is_open_loop else ("sac", "rad", "bc"):
        config = experiment(name, f"algorithm={algorithm}")
        assert config.label.startswith(f"{algorithm} ")
        assert config.algorithm_config == method(algorithm)


def test_the_quick_starts_have_values_for_a_run_of_minutes():
    close, stacking, open_loop = (
        experiment(name).algorithm_config
        for name in ("quickstart", "quickstart_stacking", "quickstart_open_loop")
    )
    assert (close.tau, close.gamma, close.learning_rate) == (0.05, 0.95, 3e-4)
    assert (close.demonstration_weight, close.imitate_successes) == (5.0, False)
    assert (stacking.tau, stacking.gamma, stacking.learning_rate) == (0.05, 0.95, 1e-3)
    assert (stacking.demonstration_weight, stacking.imitate_successes) == (30.0, True)
    assert stacking.policy_average == 0.99
    assert (open_loop.gamma, open_loop.target_interval) == (0.9, 25)


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
def test_the_quick_starts_of_close_loop_take_another_network(name):
    config = experiment(name, "network=cnn", "env.max_steps=20")
    assert config.resolved_env.config.max_steps == 20
    assert (
        config.resolved_env.config.obs_size == {"quickstart": 64, "quickstart_stacking": 128}[name]
    )
