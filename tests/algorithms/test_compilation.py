"""Learners whose loss is compiled by `torch.compile`."""

from functools import partial

import pytest
import torch
import torch._inductor.config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import recurrent_mode, set_recurrent_mode

from ba_torchrl.algorithms.compilation import CompiledLoss, check_compiler
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.checkpoint import read_config
from tests.algorithms import tiny
from tests.algorithms.tiny import FERM, PER, SIX_DOF, SO2, make_experiment, run, transitions

FLOAT32 = {"precision": "float32"}
SACFD = {"replay": PER, "rotation": SO2}
SDQFD = {"replay": PER}


@pytest.fixture(autouse=True)
def static_shapes():
    """Compile for the shapes of the first call, as learners do, and forget earlier tests."""
    torch.compiler.reset()
    # a traced loss does not reset the exploration type
    with torch._dynamo.config.patch(automatic_dynamic_shapes=False), set_exploration_type(None):
        yield
    torch.compiler.reset()


@pytest.fixture
def eager_backend(monkeypatch):
    """Trace graphs, without the compiler of the system."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))


def build(algorithm, network, precision="float32", **settings):
    sizes = {"precision": precision}
    learner = tiny.build(algorithm, network, sizes=sizes, batch_size=8, **settings)
    learner.extend(transitions(learner, 24 if network in ("cnn", "equi") else 8))
    return learner


def build_spatial(network, sequence):
    return tiny.build("spatial_q", network, sequence=sequence, sizes=FLOAT32, **SDQFD)


def assert_one_graph(loss, batch):
    loss(batch.copy())  # fills the caches of constants
    found = torch._dynamo.explain(loss)(batch)
    assert (found.graph_count, found.graph_break_count) == (1, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "network", "settings"),
    [
        ("sac", "cnn", {**SACFD, **FERM}),
        ("sac", "equi", SACFD),
        ("bc", "cnn", {}),
        ("dagger", "cnn", {}),
        ("flow", "equi", {}),
    ],
)
@pytest.mark.parametrize("precision", ["auto", "float32"])
def test_a_loss_is_one_graph(algorithm, network, settings, precision):
    learner = build(algorithm, network, precision, **settings)
    for stage in learner.stages:
        assert_one_graph(stage, learner.sample())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "sequence"),
    [
        *((name, None) for name in ("asr", "equi_fcn", "equi_asr", "equi_deictic_asr", "rot_fcn")),
        ("asr", SIX_DOF),
    ],
)
def test_a_loss_of_a_spatial_network_is_one_graph(network, sequence):
    """On a CPU and on the device "meta", whose tensors have no values."""
    learner = build_spatial(network, sequence)
    config = tiny.network_config(network, sequence, **FLOAT32)
    for device in ("cpu", "meta"):
        loss = learner.make_loss(learner.make_networks(config).to(device))
        assert_one_graph(loss, transitions(learner, 8).to(device))


@pytest.mark.slow
@pytest.mark.usefixtures("eager_backend")
@pytest.mark.parametrize(("network", "sequence"), [("equi_fcn", None), ("asr", SIX_DOF)])
def test_the_number_of_demonstrations_does_not_change_the_graph(network, sequence):
    learner = build_spatial(network, sequence)
    batch = transitions(learner, 8)
    learner.compile("default")
    learner.stages[0](batch.copy())
    with torch.compiler.set_stance("fail_on_recompile"):
        for experts, held in ((0, 8), (3, 5), (8, 0)):
            for key, count in ((keys.IS_DEMONSTRATION, experts), (keys.HOLDING, held)):
                batch[key] = (torch.arange(8) < count).reshape(batch[key].shape).to(batch[key])
            learner.stages[0](batch.copy())


def updates_equal_those_of_an_eager_learner(algorithm, network, settings, rtol):
    plain, compiled = (build(algorithm, network, **settings) for _ in range(2))
    compiled.compile("default")
    before = {key: value.clone() for key, value in compiled.loss.named_parameters()}
    for number in range(3):
        results = []
        for learner in (plain, compiled):
            torch.manual_seed(number)
            results.append(learner.update())
        assert set(results[0].keys()) == set(results[1].keys())
        for key, value in results[0].items():
            torch.testing.assert_close(results[1][key], value, rtol=rtol, atol=1e-4)
            assert not results[1][key].requires_grad
    moved = [not torch.equal(value, before[key]) for key, value in compiled.loss.named_parameters()]
    assert all(moved)
    assert plain.state_dict().keys() == compiled.state_dict().keys()
    assert plain.loss.state_dict().keys() == compiled.loss.state_dict().keys()


CASES = pytest.mark.parametrize(
    ("algorithm", "network", "settings"),
    [("sac", "cnn", {**SACFD, **FERM}), ("spatial_q", "asr", SDQFD)],
    ids=["sacfd cnn", "sdqfd asr"],
)


@pytest.mark.slow
@CASES
@pytest.mark.usefixtures("eager_backend")
def test_updates_of_a_traced_loss_equal_those_of_an_eager_learner(algorithm, network, settings):
    updates_equal_those_of_an_eager_learner(algorithm, network, settings, rtol=1e-3)


@pytest.mark.slow
@CASES
def test_updates_of_a_compiled_loss_equal_those_of_an_eager_learner(algorithm, network, settings):
    with torch._inductor.config.patch(fallback_random=True):  # draws as in eager mode
        # Adam's first steps magnify differences of small gradients
        updates_equal_those_of_an_eager_learner(algorithm, network, settings, rtol=1e-2)


@pytest.mark.slow
@pytest.mark.usefixtures("eager_backend")
def test_updates_leave_the_modes_and_are_compiled_once():
    learner = build("sac", "cnn", **SACFD)
    learner.compile("default")
    learner.update()
    with torch.compiler.set_stance("fail_on_recompile"):
        for mode in (ExplorationType.RANDOM, None):
            with set_exploration_type(mode), set_recurrent_mode(None):
                learner.update()
                assert (exploration_type(), recurrent_mode()) == (mode, None)


@torch.compiler.set_stance("force_eager")
def test_results_are_copies_and_priorities_are_written():
    learner = build("sac", "cnn", **SACFD)
    loss = CompiledLoss(learner.loss, "default")

    def change(module, _):
        module.target_entropy.sub_(1)

    handle = learner.loss.register_forward_pre_hook(change)
    loss(learner.sample())
    assert float(learner.loss.target_entropy) == -6.0  # the pass before compilation is undone
    handle.remove()
    batch = learner.sample()
    batch[keys.TD_ERROR] = torch.zeros(8, 1)  # overwritten
    returned = {}
    inner = learner.loss.forward

    def forward(data):
        returned["losses"] = inner(data)
        returned["priority"] = data[keys.TD_ERROR]
        return returned["losses"]

    loss.function = forward
    scalars = loss(batch)
    for key, value in returned["losses"].items():
        assert torch.equal(scalars[key], value)
        assert scalars[key].data_ptr() != value.data_ptr()
    assert torch.equal(batch[keys.TD_ERROR], returned["priority"])
    assert batch[keys.TD_ERROR].data_ptr() != returned["priority"].data_ptr()
    assert isinstance(scalars, TensorDict)


@torch.compiler.set_stance("force_eager")
def test_a_run_with_compile_mode(tmp_path):
    learner = run(tmp_path, "cnn", {"name": "sac"}, compile_mode="default")
    assert isinstance(learner.stages[0], CompiledLoss)


def test_a_run_without_it_is_not_compiled(tmp_path):
    learner = make_experiment(tmp_path, "cnn", {"name": "sac"}).learner
    assert learner.stages == [learner.loss]


@pytest.mark.parametrize(
    ("name", "mode", "message"),
    [
        ("rlpd", "default", "algorithm 'rlpd' cannot be.*compile_mode"),
        ("sac", "fast", "compile_mode.*reduce-overhead"),
    ],
)
def test_what_cannot_be_compiled_is_refused(tmp_path, name, mode, message):
    with pytest.raises(ConfigError, match=message):
        make_experiment(tmp_path, "cnn", {"name": name}, compile_mode=mode)


def test_a_missing_compiler_is_found_before_the_run(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ConfigError, match=r"compile_mode: .*C\+\+ compiler"):
        make_experiment(tmp_path / "run", "cnn", {"name": "sac"}, compile_mode="default")
    assert not (tmp_path / "run").exists()


def test_a_gpu_needs_a_c_compiler(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(ConfigError, match=r"compile_mode: .* C compiler"):
        check_compiler(torch.device("cuda"))
    monkeypatch.setenv("CC", "some-compiler")
    check_compiler(torch.device("cuda"))


def test_a_compiled_run_is_read_without_a_compiler(tmp_path, monkeypatch):
    made = make_experiment(tmp_path, "cnn", {"name": "sac"}, compile_mode="default")
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert read_config(tmp_path / "run").compile_mode == made.config.compile_mode


@pytest.mark.slow
@pytest.mark.usefixtures("eager_backend")
def test_the_first_update_draws_the_random_numbers_of_a_later_one():
    """A resumed run compiles the loss again at its first update."""
    learner = build("sac", "cnn", **SACFD)
    learner.compile("default")
    learner.sample()
    batch, state = learner.sample(), torch.get_rng_state()
    first = learner.stages[0](batch.copy())
    after = torch.get_rng_state()
    torch.set_rng_state(state)
    second = learner.stages[0](batch.copy())
    assert torch.equal(torch.get_rng_state(), after)
    for key, value in second.items():
        assert torch.equal(first[key], value)
