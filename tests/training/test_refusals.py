"""Errors name what the user wrote, and packages that are missing."""

import re

import pytest

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.core.errors import ConfigError
from tests.recipes import recipe
from tests.training.test_experiment import TINY, tiny

OPEN = ("task=open_loop/block_stacking", "algorithm=dqn")


@pytest.mark.parametrize("control", ["close_loop", "open_loop"])
def test_refused_networks_and_algorithms_have_the_names_of_the_registry(tmp_path, control):
    """As the user writes them, and with what the task takes instead."""
    task = {"close_loop": TINY["task"], "open_loop": "open_loop/block_stacking"}[control]
    learner, other = ("sac", "spatial_q") if control == "close_loop" else ("spatial_q", "sac")
    env = {"task": task, "env": {}, "demonstrations": 1}
    refused = [name for name in NETWORKS if NETWORKS[name].control != control]
    assert len(refused) > 3
    for name in refused:
        with pytest.raises(ConfigError, match=f"^network '{name}' is for ") as error:
            tiny(tmp_path, **env, network={"name": name}, algorithm={"name": learner})
        assert f"{control} tasks take network: " in str(error.value)
    refused = [name for name in ALGORITHMS if control not in ALGORITHMS[name].controls]
    assert other in refused
    for name in refused:
        with pytest.raises(ConfigError, match=f"^algorithm '{name}' learns ") as error:
            tiny(tmp_path, **env, algorithm={"name": name})
        assert f"{control} tasks take algorithm: " in str(error.value)
        assert learner in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("algorithm=dqn", "network=equi"),
            "algorithm 'dqn' learns open_loop tasks.*take algorithm: bc, dagger, drq, ferm, flow, ",
        ),
        (("algorithm=sac", "network=rot_fcn"), "network 'rot_fcn' is for open_loop tasks"),
        (("task=open_loop/block_stacking", *OPEN[1:], "network=equi_d4"), "network 'equi_d4' is"),
    ],
)
def test_the_command_line_names_presets(overrides, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        recipe("train", *overrides, "run_dir=new")
    assert re.search(message, capsys.readouterr().err)
