"""BulletArmExperienceReplay: demonstrations as a data set of TorchRL."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import SliceSampler, SliceSamplerWithoutReplacement
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.objectives import BCLoss, IQLLoss

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations import (
    BulletArmExperienceReplay,
    export_demonstrations,
    load_demonstrations,
    save_demonstrations,
)
from ba_torchrl.modules import squashed_gaussian_policy
from ba_torchrl.modules.actor_critic.critics import ActionValue, StateValue
from tests.modules.networks import actor_critic
from tests.tasks.episodes import demonstrations

TASK, ENV = "close_loop/block_reaching", {"obs_size": 64, "observations": ["instruction"]}
NAME = f"{TASK}/expert"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Return a folder with two sets, one of which has episodes of several lengths."""
    root = tmp_path_factory.mktemp("graded")
    for name, noise in ((NAME, 0.6), ("other", 0.0)):
        episodes = demonstrations(TASK, 3, env=ENV, noise=noise)
        save_demonstrations(root / name, episodes, task=TASK, env=ENV, seed=0)
    (root / ".other.scratch" / "other").mkdir(parents=True)
    (root / ".other.scratch" / "other" / "demonstrations.json").write_text("{}")
    return root


@pytest.fixture(scope="module")
def episodes(root):
    return load_demonstrations(root / NAME)


def test_sets_have_names_and_metadata(root):
    assert BulletArmExperienceReplay.available_datasets(root) == [NAME, "other"]
    replay = BulletArmExperienceReplay(NAME, root=root)
    assert isinstance(replay, BaseDatasetExperienceReplay)
    assert replay.metadata["task"] == TASK
    assert replay.data_path == root / NAME
    assert replay.data_path_root == replay.root == root
    assert len(BulletArmExperienceReplay(root / NAME)) == len(replay)
    with pytest.raises(ConfigError, match=r"no demonstrations at .*absent"):
        BulletArmExperienceReplay("absent", root=root)
    with pytest.raises(ConfigError, match="obs_size: collected with 64, needed 32"):
        BulletArmExperienceReplay(NAME, root=root, task=TASK, env={**ENV, "obs_size": 32})
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        replay.extend(replay[:2])


def test_samples_are_steps_of_the_demonstrations(root, episodes):
    steps = torch.cat(episodes)
    replay = BulletArmExperienceReplay(NAME, 16, root=root, prefetch=2)
    for _ in range(3):
        batch = replay.sample()
        expected = steps[batch["index"]]
        assert set(batch.keys(True)) == {*expected.keys(True), "episode", "index"}
        for key in expected.keys(True, True):
            if isinstance(expected[key], torch.Tensor):
                assert torch.equal(batch[key], expected[key]), key
        assert batch["instruction"] == expected["instruction"]
    assert len(replay) == len(steps)


def test_padded_episodes(root, episodes):
    lengths = [len(each) for each in episodes]
    assert len(set(lengths)) > 1
    replay = BulletArmExperienceReplay(NAME, 8, root=root, split_trajs=True)
    batch = replay.sample()
    assert batch.shape == (8, max(lengths))
    for row in batch:
        steps = row[row["mask"]]
        expected = episodes[int(steps["episode"][0])]
        assert torch.equal(steps["next", "depth"], expected["next", "depth"])
        assert not row[~row["mask"]]["depth"].any()


@pytest.mark.parametrize("sampler", [SliceSampler, SliceSamplerWithoutReplacement])
def test_slices_are_those_of_episodes(root, episodes, sampler):
    longest = max(map(len, episodes))
    replay = BulletArmExperienceReplay(
        NAME, 2 * longest, root=root, sampler=sampler(num_slices=2, strict_length=False)
    )
    batch, found = replay.sample(), 0
    for number in batch["episode"].unique_consecutive().tolist():
        part = batch[batch["episode"] == number]
        count = len(episodes[number])
        found += len(part)
        assert torch.equal(part["step_count"][:count], episodes[number]["step_count"])
        assert part["next", "done"][count - 1]
    assert found == len(batch)


@pytest.mark.parametrize("kind", [BCLoss, IQLLoss])
def test_an_update_with_a_loss_of_torchrl(root, kind):
    networks, observation = actor_critic("cnn"), ["depth", "holding"]
    policy = squashed_gaussian_policy(networks.actor, observation)
    parts = []
    if kind is IQLLoss:
        values = ActionValue(networks.encoder, networks.critic)
        state_value = StateValue(networks.encoder, networks.critic, 5)
        parts += [
            TensorDictModule(values, [*observation, "action"], ["state_action_value"]),
            TensorDictModule(state_value, observation, ["state_value"]),
        ]
    loss = kind(policy, *parts)
    before = nn.utils.parameters_to_vector(loss.parameters()).detach().clone()
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    replay = BulletArmExperienceReplay(NAME, 4, root=root)
    terms = loss(replay.sample())
    sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
    optimizer.step()
    after = nn.utils.parameters_to_vector(loss.parameters())
    assert after.isfinite().all()
    assert (after != before).float().mean() > 0.3


def test_a_file_of_another_library(root, episodes, tmp_path):
    pytest.importorskip("h5py")
    path = tmp_path / "reaching.hdf5"
    export_demonstrations(path, episodes, format="hdf5", task=TASK, env=ENV, seed=0)
    replay = BulletArmExperienceReplay(path, 4, task=TASK, env=ENV)
    assert replay.metadata == {}
    assert torch.equal(replay[:]["next", "depth"], torch.cat(episodes)["next", "depth"])
