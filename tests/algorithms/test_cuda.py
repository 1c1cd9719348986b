"""Learners on a GPU."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from profiling import learning
from profiling.table import Bench, Budget
from tests.algorithms import tiny
from tests.algorithms.tiny import OPEN, PER, SO2, make_experiment, run, transitions

pytestmark = pytest.mark.cuda

SACFD = {"name": "sac", "replay": PER, "rotation": SO2}


def build(network, device, algorithm="sac", **settings):
    """A learner that computes in float32."""
    on = tiny.problem(network, device=device)
    return tiny.build(algorithm, network, sizes={"precision": "float32"}, on=on, **settings)


def parameters(learner):
    return dict(learner.loss.named_parameters())


@pytest.mark.parametrize(
    ("network", "algorithm", "changes"),
    [
        ("cnn", SACFD, {}),
        ("equi", SACFD, {}),
        ("cnn", {"name": "rlpd", "replay": {"name": "symmetric"}}, {}),
        ("cnn", {"name": "iql"}, {"pretrain_updates": 1}),
        ("cnn", {"name": "bc"}, {}),
        ("cnn", {"name": "dagger"}, {}),
        ("equi", {"name": "flow", "rotation": {"name": "sampled"}}, {}),
        ("asr", {"name": "spatial_q"}, OPEN),
    ],
    ids=["sacfd cnn", "sacfd equi", "rlpd", "iql", "bc", "dagger", "flow equi", "sdqfd asr"],
)
def test_a_run_learns_on_the_device_and_its_state_loads_on_the_cpu(
    network, algorithm, changes, tmp_path, cuda
):
    learner = run(tmp_path, network, algorithm, **changes, device=str(cuda))
    found = parameters(learner)
    assert {value.device.type for value in found.values()} == {cuda.type}
    assert all(value.isfinite().all() for value in found.values())
    other = make_experiment(tmp_path / "cpu", network, algorithm, **changes, device="cpu").learner
    assert any(not torch.equal(value.cpu(), parameters(other)[key]) for key, value in found.items())
    other.load_state_dict(learner.state_dict())
    for key, value in parameters(other).items():
        torch.testing.assert_close(value, found[key].cpu(), rtol=0, atol=0)


@pytest.mark.parametrize("network", ["cnn", "equi"])
def test_actions_are_those_of_the_cpu(network, cuda):
    here, there = (build(network, device) for device in (torch.device("cpu"), cuda))
    there.load_state_dict(here.state_dict())
    states = transitions(here).select(*here.observation_keys)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        actions = here.policy(states.clone())["action"]
        found = there.policy(states.to(cuda))["action"]
    assert actions.std(dim=0).max() > 0
    torch.testing.assert_close(found.cpu(), actions, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("network", ["cnn", "equi"])
def test_the_host_does_not_wait_for_an_update(network, cuda):
    settings = {key: value for key, value in SACFD.items() if key != "name"}
    learner = build(network, cuda, **settings)
    learner.extend(transitions(learner))
    for _ in range(3):
        learner.update()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        learner.update()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(learner.host_tasks) > 0


@pytest.mark.parametrize("mode", ["default", "reduce-overhead"])
def test_compiled_updates_equal_eager_ones(mode, cuda):
    """Behaviour cloning, whose loss draws no random numbers."""
    torch.compiler.reset()
    eager, compiled = (build("cnn", cuda, "bc", batch_size=8) for _ in range(2))
    before = {key: value.clone() for key, value in parameters(compiled).items()}
    compiled.compile(mode)
    for learner in (eager, compiled):
        learner.extend(transitions(learner))
        torch.manual_seed(0)
        for _ in range(5):  # CUDA graphs are recorded in the second and then replayed
            learner.update()
    expected = parameters(eager)
    for key, value in parameters(compiled).items():
        assert not torch.equal(value, before[key])
        torch.testing.assert_close(value, expected[key], rtol=1e-2, atol=1e-3)


def test_the_images_of_a_batch_are_those_of_the_cpu(cuda):
    here, there = (build("cnn", device) for device in (torch.device("cpu"), cuda))
    for learner in (here, there):
        learner.extend(transitions(learner))
    one, two = here.sample(), there.sample()
    assert {value.device.type for value in two.values(True, True)} == {cuda.type}
    for key in one.keys(True, True):
        torch.testing.assert_close(two[key].cpu(), one[key], rtol=0, atol=1e-6)


def test_speed_of_an_update(cuda):
    experiment = {"task": "close_loop/block_reaching", "algorithm": {"name": "sac"}}
    with tqdm(disable=True) as bar:
        (row,) = learning.measure_update(
            Bench(3, bar, device=cuda),
            learning.Update("update", experiment, {"name": "cnn"}, 64, Budget("1", 1.0, 1.0)),
        )
    assert row.budget is None  # the budgets are those of a CPU
    assert 0 < row.share_of_limit < 1
