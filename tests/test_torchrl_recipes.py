"""The algorithms that are written as one script, run with tiny values."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, exploration_type

from ba_torchrl.envs import keys

FOLDER = Path(__file__).parents[1] / "recipes" / "torchrl"
TINY = {
    "num_envs": 2,
    "demonstrations": 2,
    "pretrain_updates": 2,
    "total_updates": 4,
    "batch_size": 4,
    "eval_every": 2,
    "eval_episodes": 2,
    "final_eval_episodes": 3,
    "device": "cpu",
}
RUNS = {
    "sacfd equi": {"task": "close_loop/block_reaching", "network": "equi", "width": 8},
    "sacfd cnn": {"task": "close_loop/block_reaching", "network": "cnn", "width": 16},
    "sdqfd equi_asr": {"num_objects": 2, "num_rotations": 4, "width": 0.125, "obs_size": 32},
    "sdqfd asr": {"num_objects": 2, "network": "asr", "num_rotations": 4, "width": 0.125},
}


def script(name):
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recorded(monkeypatch):
    """Replays and optimisers of a script, and the kinds of exploration of its policy."""
    found = {"explorations": []}

    def watch(module):
        make, policy = module.make_replay_buffer, module.ActingPolicy

        class Policy(policy):
            def forward(self, tensordict):
                found["explorations"].append(exploration_type())
                return super().forward(tensordict)

        def make_replay_buffer(*args):
            found["replay"] = make(*args)
            return found["replay"]

        monkeypatch.setattr(module, "make_replay_buffer", make_replay_buffer)
        monkeypatch.setattr(module, "ActingPolicy", Policy)
        return found

    return watch


@pytest.mark.parametrize("run", RUNS)
def test_a_script_trains_and_prints_its_evaluation(run, recorded, capsys):
    name, _ = run.split()
    module = script(name)
    found = recorded(module)
    weights = []
    loss = module.make_loss

    def make_loss(*args):
        made = loss(*args)
        weights.append((made, [p.detach().clone() for p in made.parameters()]))
        return made

    module.make_loss = make_loss
    rate = module.main(module.Config(**TINY, **RUNS[run]))
    assert 0 <= rate <= 1
    assert f"success_rate {rate:.2f} over 3 episodes" in capsys.readouterr().out
    ((made, before),) = weights
    changed = [not torch.equal(p, q) for p, q in zip(made.parameters(), before, strict=True)]
    assert sum(changed) > len(changed) / 2
    is_demonstration = found["replay"].storage.column(keys.IS_DEMONSTRATION)
    assert is_demonstration.any()
    assert (~is_demonstration).sum() == 4  # two updates with a step of two environments each
    assert found["explorations"].count(ExplorationType.RANDOM) == 2
    assert ExplorationType.DETERMINISTIC in found["explorations"]


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_script_is_one_page(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 200
    assert "Experiment" not in text
    assert "Learner" not in text


def test_the_folder_does_not_hide_torchrl():
    # a package recipes/torchrl would be imported by recipes/*.py in place of TorchRL
    assert not (FOLDER / "__init__.py").exists()
