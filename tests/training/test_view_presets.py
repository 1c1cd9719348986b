"""Presets with random views of the images in a whole run: collection, updates and evaluation."""

import pytest

from ba_torchrl.record.logging import read_scalars
from ba_torchrl.training.experiment import Experiment
from tests.algorithms.test_variants import method
from tests.training.test_experiment import tiny


@pytest.mark.parametrize(
    ("preset", "network", "obs_size"),
    [
        ("rad_sac", "cnn", 64),
        ("drq_sacfd_per", "cnn", 64),
        ("ferm_sacfd", "ferm", 142),
        pytest.param("rad_sacfd", "cnn", 64, marks=pytest.mark.slow),
        pytest.param("drq_sac", "cnn", 64, marks=pytest.mark.slow),
        pytest.param("ferm_sacfd_per", "ferm", 142, marks=pytest.mark.slow),
    ],
)
def test_a_run_collects_learns_and_evaluates(tmp_path, preset, network, obs_size):
    algorithm, pretraining = {**method(preset), "batch_size": 4}, {}
    if network == "ferm":  # pretraining of the encoder alone
        algorithm["contrastive"] = {**algorithm["contrastive"], "updates": 2}
        pretraining = {"pretrain_updates": 0}
    config = tiny(
        tmp_path,
        algorithm=algorithm,
        network={"name": network, "width": 0.1},
        env={"obs_size": obs_size, "max_steps": 5},
        total_updates=4,
        eval_every=4,
        video_episodes=0,
        **pretraining,
    )
    result = Experiment(config, progress=False).run()
    scalars = read_scalars(tmp_path / "run")
    assert result.updates == 4
    assert scalars["eval/success_rate"].steps.tolist() == [0, 4]
    without = [] if network == "ferm" else [1, 2]
    assert scalars["train/loss_qvalue"].steps.tolist() == [*without, 3, 4]
    assert ("train/loss_contrastive" in scalars) is (network == "ferm")
