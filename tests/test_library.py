"""What users see of the package: names, help, and TorchRL's own parts around an environment."""

import pydoc

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.envs import Compose, ParallelEnv, RewardScaling, StepCounter, TransformedEnv

import ba_torchrl
from ba_torchrl import data, envs, modules, objectives
from ba_torchrl.core.errors import install_command

REACH = "close_loop/block_reaching"


def test_the_help_of_the_package_shows_its_functions():
    text = pydoc.plain(pydoc.render_doc(ba_torchrl))
    for name in ("make", "make_vector_env", "list_tasks", "list_robots", "describe", "load_policy"):
        assert f"    {name}(" in text
        assert getattr(ba_torchrl, name).__doc__.strip().splitlines()[0] in text


@pytest.mark.parametrize("package", [ba_torchrl, data, envs, modules, objectives])
def test_every_public_name_is_described(package):
    for name in set(package.__all__) - {"__version__", "NETWORKS"}:
        assert (getattr(package, name).__doc__ or "").strip(), name
        assert name in dir(package)


@pytest.mark.slow
def test_a_torchrl_script_works_as_torchrls_documentation_says():
    env = TransformedEnv(
        ParallelEnv(2, lambda: ba_torchrl.make(REACH, obs_size=16), mp_start_method="fork"),
        Compose(RewardScaling(0.0, 2.0), StepCounter(step_count_key="count")),
    )
    data.use_python_segment_trees()
    replay = TensorDictPrioritizedReplayBuffer(
        alpha=0.6, beta=0.4, storage=LazyTensorStorage(50), batch_size=4
    )
    collector = Collector(env, None, frames_per_batch=10, total_frames=20)
    try:
        for batch in collector:
            replay.extend(batch.reshape(-1))
    finally:
        collector.shutdown()
    sample = replay.sample()
    assert sample["next", "count"].max() >= 1
    sample["td_error"] = torch.ones(4)
    replay.update_tensordict_priority(sample)


def test_the_command_that_installs_a_package_has_its_bounds(monkeypatch):
    monkeypatch.setattr(
        "ba_torchrl.core.errors.requires", lambda _: ['hydra-core<1.4,>=1.3.2; extra == "train"']
    )
    found = install_command("hydra-core", "other")
    assert found == "pip install 'hydra-core<1.4,>=1.3.2' other"
