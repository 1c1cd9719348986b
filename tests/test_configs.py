"""Every configuration that ships describes a run that can start."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

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


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("network", NETWORKS)
def test_presets_compose(algorithm, network):
    config = experiment("train", f"algorithm={algorithm}", f"network={network}", "seed=3")
    assert config.label == f"{algorithm} {network}"
    assert config.run_dir.endswith(f"close_loop_block_picking-{algorithm}_{network}-seed3")


def test_the_paper_sets_the_defaults():
    config = experiment("train")
    algorithm, network = config.algorithm_config, config.network_config
    assert (algorithm.learning_rate, algorithm.gamma, algorithm.batch_size) == (1e-3, 0.99, 64)
    assert (algorithm.alpha_init, algorithm.target_entropy, algorithm.tau) == (0.01, -5.0, 0.01)
    assert (algorithm.priority_exponent, algorithm.importance_exponent) == (0.6, 0.4)
    assert (algorithm.expert_bonus, algorithm.demonstration_weight) == (1.0, 1.0)
    assert algorithm.buffer_size == 100_000
    assert (network.group_order, network.n_hidden) == (8, 64)
    assert (config.num_envs, config.eval_every, config.env_config.obs_size) == (5, 500, 128)


def test_sac_is_sacfd_without_demonstrations_in_its_loss():
    sac = experiment("train", "algorithm=sac").algorithm_config
    assert sac.demonstration_weight == 0
    assert not sac.prioritized


@pytest.mark.parametrize("network", NETWORKS)
def test_the_quick_start_takes_any_network(network):
    config = experiment("quickstart", f"network={network}", "env.max_steps=20")
    assert config.env_config.max_steps == 20
    assert config.env_config.obs_size == 64
