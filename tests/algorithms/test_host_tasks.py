"""Results of a device that are used on the host later, and updates that do not wait for them."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ba_torchrl.algorithms.host_tasks import HostTasks
from ba_torchrl.core import keys
from tests.algorithms.tiny import FERM, PER, SIX_DOF, SO2, build, network_config, transitions

CPU = torch.device("cpu")
SACFD = {"replay": PER, "rotation": SO2}


def deferred(algorithm="sac", network="cnn", **settings):
    """A learner whose host tasks are deferred as on a GPU."""
    learner = build(algorithm, network, **settings)
    learner.host_tasks = HostTasks(CPU, is_deferred=True)
    learner.extend(transitions(learner))
    return learner


def parameters(learner):
    return [value.detach().clone() for value in learner.loss.parameters()]


def priorities(learner):
    count = len(learner.replay)
    return torch.as_tensor(learner.replay.sampler._sum_tree[torch.arange(count)]).clone()


def test_tasks_run_at_once_on_a_cpu():
    tasks, seen = HostTasks(CPU), []
    tasks.submit({"value": torch.ones(2, requires_grad=True)}, seen.append)
    assert seen[0]["value"].tolist() == [1, 1]
    assert not seen[0]["value"].requires_grad
    assert len(tasks) == 0


def test_deferred_tasks_run_in_order_with_the_values_of_their_submission():
    tasks, seen = HostTasks(CPU, is_deferred=True), []
    value = torch.zeros(())
    for _ in range(3):
        tasks.submit({"value": value}, lambda values: seen.append(values["value"].item()))
        value += 1
    assert seen == []
    tasks.run(2)
    assert seen == [0, 1]
    assert len(tasks) == 1
    tasks.run()
    assert seen == [0, 1, 2]


def test_an_error_drops_the_tasks_after_it():
    def fail(values):
        raise FloatingPointError

    tasks, seen = HostTasks(CPU, is_deferred=True), []
    for task in (seen.append, fail, seen.append):
        tasks.submit({}, task)
    with pytest.raises(FloatingPointError):
        tasks.run()
    tasks.run()
    assert seen == [{}]


def test_priorities_are_set_at_the_end_of_the_next_update():
    learner = deferred(**SACFD)
    before = priorities(learner)
    learner.update()
    assert torch.equal(priorities(learner), before)
    learner.update()
    after_two = priorities(learner)
    assert not torch.equal(after_two, before)
    learner.state_dict()
    assert not torch.equal(priorities(learner), after_two)
    assert len(learner.host_tasks) == 0


def test_the_first_update_is_that_of_the_cpu():
    waits, goes_on = build(**{"algorithm": "sac", **SACFD}), deferred(**SACFD)
    waits.extend(transitions(waits))
    torch.manual_seed(1)
    waits.update()
    torch.manual_seed(1)
    goes_on.update()
    goes_on.state_dict()
    for one, two in zip(parameters(waits), parameters(goes_on), strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0)
    assert torch.equal(priorities(waits), priorities(goes_on))


@pytest.mark.parametrize(
    ("network", "settings"), [("cnn", SACFD), ("ferm", FERM)], ids=["one stage", "two stages"]
)
def test_a_loss_that_is_not_finite_changes_nothing_and_is_reported_in_the_next_update(
    tmp_path, network, settings
):
    def steps():
        states = learner.stepper.state_dict()
        names = [name for name in states if name.endswith("optimizer")]
        return [each["step"].item() for name in names for each in states[name]["state"].values()]

    learner = deferred(network=network, **settings)
    learner.update()
    before = parameters(learner)
    steps_before = steps()
    sound = learner.sample

    def broken(**options):
        batch = sound(**options)
        batch[keys.NEXT, keys.REWARD] += torch.nan
        return batch

    learner.sample = broken
    learner.update()
    for one, two in zip(before, parameters(learner), strict=True):
        assert torch.equal(one, two)
    assert steps() == steps_before
    learner.sample = sound
    with pytest.raises(FloatingPointError, match="not finite at update 1"):
        learner.update()
    learner.replay_state()  # the state can be saved


READS = {"aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal"}


class ReadsOnTheHost(TorchDispatchMode):
    """Counts operations whose result a GPU's host would have to wait for."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name
        has_mask = name in ("aten::index", "aten::index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if name in READS or has_mask:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    ("algorithm", "network", "settings"),
    [
        ("sac", "cnn", SACFD),
        ("sac", "equi", {**SACFD, "optimizer": {"gradient_clamp": 1.0, "policy_average": 0.9}}),
        ("sac", "cnn", {"views": {"name": "shift", "views": 2, "target_views": 2}}),
        ("sac", "ferm", {**FERM, "optimizer": {"gradient_clamp": 1.0}}),
        ("rlpd", "cnn", {"replay": {"name": "symmetric"}}),
        ("bc", "cnn", {}),
        ("dagger", "cnn", {}),
        ("flow", "equi", {}),
    ],
)
def test_the_host_reads_no_result_during_an_update(algorithm, network, settings):
    learner = deferred(algorithm, network, **settings)
    for _ in range(2):  # the optimiser's state exists afterwards
        batch = learner.sample()
        learner.minimize(batch, learner.stages)
    learner.state_dict()
    batch = learner.sample()
    with ReadsOnTheHost() as reads:
        learner.minimize(batch, learner.stages)
    # AveragedModel reads its own counter, which is on the CPU for any device
    counter = 3 * ["aten::_local_scalar_dense"] if learner.averaged_policy is not None else []
    assert reads.found == counter
    assert len(learner.host_tasks) == len(learner.stages)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize(
    ("network", "sequence", "kind"),
    [
        *(("asr", None, kind) for kind in ("none", "adet", "dqfd", "sdqfd")),
        ("asr", SIX_DOF, "sdqfd"),
        *(
            (name, None, "sdqfd")
            for name in ("equi_asr", "equi_deictic_asr", "equi_fcn", "rot_fcn")
        ),
    ],
)
def test_losses_of_spatial_networks_read_no_result(network, sequence, kind):
    """Tensors of the device "meta" have no values, and reading one raises an error."""
    learner = build("spatial_q", network, sequence=sequence, imitation={"name": kind})
    loss = learner.make_loss(learner.make_networks(network_config(network, sequence)).to("meta"))
    terms = loss(transitions(learner, 8).to("meta"))
    sum(terms[key] for key in loss.out_keys if key.startswith("loss_")).backward()
    assert all(value.device.type == "meta" for value in terms.values())


def test_priorities_are_set_before_their_transitions_are_overwritten():
    """New transitions get the largest error so far, and no error of those that they replace."""
    learner = deferred(**{**SACFD, "replay": {"name": "prioritized", "capacity": 24}})
    learner.update()
    assert len(learner.host_tasks) == 2
    learner.extend(transitions(learner)[1::2])  # in place of the 12 that are no demonstrations
    assert len(learner.host_tasks) == 0
    demonstrations, new = priorities(learner)[::2], priorities(learner)[1::2]
    assert (demonstrations != demonstrations[0]).any()
    assert (new == new[0]).all()
