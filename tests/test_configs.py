"""Every configuration that ships describes a run that can start."""

from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ba_torchrl.algorithms import base as registries
from ba_torchrl.commands import train
from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.presets import preset, started

CONFIGS = Path(__file__).parents[1] / "configs"
ALGORITHMS, NETWORKS = (
    sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
    for group in ("algorithm", "network")
)


def experiment(name, *overrides):
    arguments = train.COMMAND.read(["--config-name", name, *overrides])
    with train.COMMAND.composed(arguments) as settings:
        return train.parse(OmegaConf.to_container(settings, resolve=True), arguments)


TASK_OF = {"close_loop": "close_loop/block_picking", "open_loop": "open_loop/block_stacking"}


@cache
def presets(group):
    """The values of each preset of a group."""
    names = sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
    with started(CONFIGS):
        return {name: preset(group, name) for name in names}


def controls_of(algorithm):
    return registries.ALGORITHMS[presets("algorithm")[algorithm]["name"]].controls


def networks_for(control):
    values = presets("network").items()
    return [name for name, own in values if registries.NETWORKS[own["name"]].control == control]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_composes_with_a_network_of_its_control(algorithm):
    for control in sorted(controls_of(algorithm)):
        overrides = [f"task={TASK_OF[control]}", f"algorithm={algorithm}", "seed=3"]
        network = networks_for(control)[0]
        config = experiment("train", *overrides, f"network={network}")
        method = "sacfd_per_so2" if algorithm == "sacfd" else algorithm
        assert config.label == f"{method} {network}"
        name = TASK_OF[control].replace("/", "_")
        assert config.run_dir.endswith(f"{name}-{method}_{network}-seed3")


@pytest.mark.parametrize(
    ("task", "algorithm", "network"),
    [(TASK_OF["close_loop"], "bc", "asr"), (TASK_OF["open_loop"], "bc", "cnn")],
)
def test_a_network_of_the_other_control_is_refused(task, algorithm, network):
    with pytest.raises(ConfigError, match="network"):
        experiment("train", f"task={task}", f"algorithm={algorithm}", f"network={network}")


@pytest.mark.parametrize("name", registries.NETWORKS)
def test_the_sizes_of_a_network_are_bounded(name):
    """A policy in a file has the settings that somebody else wrote."""
    for field, info in registries.NETWORKS[name].model_fields.items():
        if info.annotation in (int, int | None) or field.endswith("width"):
            assert any(hasattr(bound, "le") for bound in info.metadata), field


@pytest.mark.parametrize("network", NETWORKS)
def test_every_network_composes(network):
    control = presets("network")[network]["name"]
    control = registries.NETWORKS[control].control
    algorithm = {"close_loop": "sac", "open_loop": "dqn"}[control]
    overrides = (f"task={TASK_OF[control]}", f"algorithm={algorithm}", f"network={network}")
    assert experiment("train", *overrides).label == f"{algorithm} {network}"


@cache
def method(name):
    with started(CONFIGS):
        values = preset("algorithm", name)
    return parse(registries.ALGORITHMS[values.pop("name")], values, name)


@pytest.mark.parametrize(
    "name", ["sac_so2", "sacfd_per_so2", "rad_sac", "rad_sacfd_so2", "drq_per", "sdqfd_per"]
)
def test_a_method_is_an_algorithm_a_replay_and_a_rotation(name):
    parts = name.split("_")
    groups = {"algorithm": parts[0], "replay": "uniform", "rotation": "none"}
    groups |= {"replay": "per"} if "per" in parts else {}
    groups |= {"rotation": "so2"} if "so2" in parts else {}
    lines = [f"{group}={value}" for group, value in groups.items()]
    lines += ["algorithm.imitation.name=none"] if "sac" in parts[1:] else []
    if parts[0] == "sdqfd":
        lines += ["task=open_loop/block_stacking", "network=asr"]
    assert experiment("train", *lines).algorithm == method(name)


@pytest.mark.parametrize(
    ("overrides", "label"),
    [
        (["algorithm={name: rlpd}", "algorithm.replay.name=symmetric"], "rlpd_symmetric_so2 equi"),
        (["algorithm={name: iql, replay: {name: uniform}}"], "iql equi"),  # has no rotation
        (["algorithm={name: sac}"], "sacfd_per_so2 equi"),  # as it is
        (["algorithm={gamma: 0.9}", "network={name: cnn}"], "sacfd_per_so2 cnn"),
        (["algorithm=rad", "algorithm.imitation.name=none"], "rad_imitation_none equi"),
        (["algorithm.replay.name=uniform", "algorithm.rotation.name=stored"], "sacfd_stored equi"),
    ],
)
def test_the_label_names_the_parts_that_replace_those_of_presets(overrides, label):
    config = experiment("train", *overrides)
    assert config.label == label
    assert f"-{label.replace(' ', '_')}-seed0" in config.run_dir


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bc_per", "replay.name: must be 'uniform'"),
        ("rlpd_per", "replay.name: must be 'symmetric'"),
        ("iql_so2", "unknown parameter 'rotation'"),
        ("sdqfd_so2", "unknown rotation.name 'sampled'.*Known: none, translation, d4"),
        ("sacfd_so2_per", "unknown algorithm 'sacfd_so2_per'.*Known: .*sacfd"),
        ("sacfd_", "unknown algorithm 'sacfd_'"),
        ("sacdf", "Did you mean 'sacfd'"),
    ],
)
def test_methods_that_do_not_exist_are_refused(name, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        method(name)


@pytest.mark.parametrize("name", sorted(path.stem for path in CONFIGS.glob("quickstart*.yaml")))
def test_other_algorithms_have_their_own_values_in_every_quick_start(name):
    """The values of a quick start are those of its algorithm: sac gets no behaviour term."""
    is_open_loop = name in ("quickstart_open_loop", "quickstart_six_dof")
    for algorithm in ("dqn",) if is_open_loop else ("sac", "bc"):
        config = experiment(name, f"algorithm={algorithm}")
        assert config.label.startswith(f"{algorithm} ")
        assert config.algorithm == method(algorithm)


def test_chunks_of_small_steps_are_shorter_than_an_episode():
    config = experiment("quickstart_small_steps", "algorithm.horizon=8")
    assert config.env.config.dpos == 0.02
    assert config.algorithm.horizon == 8


@pytest.mark.parametrize(
    ("words", "part", "options"),
    [
        (["algorithm.imitation.name=none"], "imitation", {"name": "none"}),
        (["algorithm.imitation={name: none}"], "imitation", {"name": "none"}),
        (
            ["algorithm.imitation.name=successes", "algorithm.imitation.weight=2.0"],
            "imitation",
            {"name": "successes", "weight": 2.0, "distance": "kl"},
        ),
        (
            ["algorithm=ferm", "network=ferm", "algorithm.views.name=shift"],
            "views",
            {"name": "shift", "pixels": 4, "views": 1, "target_views": 1},
        ),
        (["algorithm.imitation.name=none", "algorithm.imitation.weight=2"], "imitation", None),
        (["algorithm.imitation={name: none, weight: 2}"], "imitation", None),
    ],
)
def test_a_part_that_replaces_that_of_a_preset_keeps_the_values_that_it_has(words, part, options):
    arguments = train.COMMAND.read(["--config-name=quickstart", *words])
    with train.COMMAND.composed(arguments) as settings:
        values = OmegaConf.to_container(settings, resolve=True)
        if options is None:  # the user's own value
            with pytest.raises(ConfigError, match=r"unknown.*imitation.name=demonstrations or"):
                train.parse(values, arguments)
        else:
            config = train.parse(values, arguments).algorithm
            assert getattr(config, part).model_dump() == options
