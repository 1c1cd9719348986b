"""A run ends early once two evaluations in a row reach a success rate."""

import pytest

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.record.results import read_result
from ba_torchrl.training import experiment as experiments
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation
from ba_torchrl.training.experiment import Experiment
from tests.training.test_experiment import TINY
from tests.training.test_resume import Interrupted, raise_interrupted

UNTRAINED = 1.0
RATES = [UNTRAINED, 0.9, 0.5, 1.0, 0.9, 1.0, 1.0]


def config_for(tmp_path, **changes):
    settings = {"total_updates": 12, "eval_every": 2, "stop_at_success": 0.9, "video_episodes": 0}
    folder = {"run_dir": str(tmp_path / "run")}
    return ExperimentConfig.parse({**TINY, **settings, **folder, **changes})


@pytest.fixture
def seeds(monkeypatch):
    """Seeds of the evaluations, whose success rates are `RATES` in turn."""
    seen = []

    def evaluate(env, policy, episodes, seed, on_episode=None):
        seen.append(seed)
        return Evaluation(episodes, RATES[min(len(seen), len(RATES)) - 1], 0.0, 5.0)

    monkeypatch.setattr(experiments, "evaluate", evaluate)
    return seen


def test_a_run_ends_after_two_successful_evaluations_in_a_row(tmp_path, seeds, caplog):
    config = config_for(tmp_path)
    with caplog.at_level("INFO"):
        result = Experiment(config, progress=False).run()
    assert result.updates == 8
    assert "the run ends at update 8" in caplog.text
    result = read_result(config.folder)
    assert [point.updates for point in result.curve] == [0, 2, 4, 6, 8]
    assert result.last.updates == 8
    assert result.curve[0].success_rate == UNTRAINED
    assert seeds[0] == seeds[1]
    assert len(set(seeds[1:])) == len(seeds[1:]) == 4


def test_without_a_rate_all_updates_are_taken_and_the_episodes_are_the_same(tmp_path, seeds):
    config = config_for(tmp_path, stop_at_success=None)
    assert Experiment(config, progress=False).run().updates == 12
    assert seeds == [config.derived_seed(SeedUse.EVALUATION)] * 7


def test_a_run_ends_while_it_learns_from_demonstrations_alone(tmp_path, seeds):
    config = config_for(tmp_path, pretrain_updates=12, stop_at_success=0.4)
    assert Experiment(config, progress=False).run().updates == 4


def test_a_run_that_has_ended_takes_no_update_when_it_is_resumed(tmp_path, seeds, monkeypatch):
    first = Experiment(config_for(tmp_path), progress=False)
    with monkeypatch.context() as patch:
        patch.setattr(experiments, "write_run_result", raise_interrupted)
        with pytest.raises(Interrupted):
            first.run()
    experiment = Experiment(config_for(tmp_path, resume=True), progress=False)
    experiment.learner.update = None
    assert experiment.run().updates == 8
