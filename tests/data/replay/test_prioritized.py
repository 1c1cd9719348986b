"""Segment trees and the expert-prioritised sampler, against the formulas."""

import copy
import time

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import prioritized

from ba_torchrl.core import keys
from ba_torchrl.core.files import read_state, write_state
from ba_torchrl.data.replay import segment_tree
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from tests.fresh import run_script

EPS = 1e-6
segment_tree.use_python_segment_trees()


def back_ends():
    """The NumPy trees, and TorchRL's native ones if its extension loads."""
    yield pytest.param((segment_tree.SumTree, segment_tree.MinTree), id="numpy")
    yield pytest.param((segment_tree.SumTreeFp32, segment_tree.MinTreeFp32), id="numpy-fp32")
    native = prioritized.SumSegmentTreeFp64, prioritized.MinSegmentTreeFp64
    if native[0] is not segment_tree.SumTree:
        yield pytest.param(native, id="native")


@pytest.mark.parametrize("trees", [*back_ends()])
@pytest.mark.parametrize("capacity", [1, 7, 64, 1000])
def test_trees_against_plain_arrays(trees, capacity):
    rng = np.random.default_rng(0)
    total, smallest = trees[0](capacity), trees[1](capacity)
    values = np.zeros(capacity)
    for size in (1, min(3, capacity), capacity):  # single paths, and whole levels
        index = torch.from_numpy(rng.permutation(capacity)[:size])
        new = torch.from_numpy(rng.random(size) + 0.1)
        total[index], smallest[index] = new, new
        values[index] = new
    assert np.asarray(total[torch.arange(capacity)]).reshape(-1) == pytest.approx(values, rel=1e-6)
    for _ in range(20):
        low, high = sorted(rng.integers(0, capacity + 1, 2))
        if low == high:
            continue
        assert total.query(int(low), int(high)) == pytest.approx(values[low:high].sum(), rel=1e-6)
        assert smallest.query(int(low), int(high)) == pytest.approx(
            values[low:high].min(), rel=1e-6
        )
    mass = rng.random(200) * values.sum()
    expected = np.searchsorted(np.cumsum(values), mass, side="left")
    found = np.asarray(total.scan_lower_bound(torch.from_numpy(mass)))
    assert (found == expected).mean() > 0.99  # a mass on an edge may round to either side
    assert np.abs(found - expected).max() <= 1
    assert total.scan_lower_bound(float(mass[0])) in (expected[0] - 1, expected[0], expected[0] + 1)


def test_single_values_and_unset_leaves():
    total, smallest = segment_tree.SumTree(5), segment_tree.MinTree(5)
    total[2], smallest[2] = 4.0, 4.0
    assert total[2] == 4
    assert total[0] == 0
    assert total.query(0, 5) == smallest.query(0, 5) == 4
    assert smallest.query(0, 2) == np.inf
    assert total.scan_lower_bound(3.0) == 2
    assert total.scan_lower_bound(9.0) == len(total) == total.size == 5
    clone = copy.deepcopy(total)
    total[2] = 1.0
    assert clone.query(0, 5) == 4
    for index in (total.capacity, -1, torch.tensor([total.capacity])):
        with pytest.raises(IndexError):
            total[index] = 1.0


def test_leaves_are_rounded_up_to_a_power_of_two_as_native_ones():
    capacities = {size: segment_tree.SumTree(size).capacity for size in (1, 5, 7, 8)}
    assert capacities == {1: 2, 5: 8, 7: 8, 8: 16}
    sampler = PrioritizedSampler(5, alpha=1.0, beta=1.0)  # with fewer leaves than the storage
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(8), sampler=sampler, batch_size=64, priority_key="priority"
    )
    buffer.extend(TensorDict({"x": torch.arange(8), "priority": torch.ones(8)}, [8]))
    assert buffer.sample()["x"].unique().tolist() == list(range(8))


def test_native_trees_are_kept(monkeypatch):
    marker = type("Native", (), {})
    monkeypatch.setattr(prioritized, "SumSegmentTreeFp32", marker)
    monkeypatch.setattr(prioritized, "MinSegmentTreeFp64", None)
    segment_tree.use_python_segment_trees()
    assert prioritized.SumSegmentTreeFp32 is marker
    assert prioritized.MinSegmentTreeFp64 is segment_tree.MinTree


OF_TORCHRL = """
import warnings
warnings.simplefilter("error", UserWarning)
import numpy as np
import torch
import ba_torchrl
from torchrl.data.replay_buffers.samplers import prioritized

native = dict(vars(prioritized))
import ba_torchrl.envs.base
from ba_torchrl.data import ExpertPrioritizedSampler, use_python_segment_trees

ExpertPrioritizedSampler(4)
assert vars(prioritized) == native
use_python_segment_trees()
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer

np.random.seed(0)
torch.manual_seed(0)


def make(**changes):
    return TensorDictPrioritizedReplayBuffer(
        alpha=0.7, beta=0.5, storage=LazyTensorStorage(12), batch_size=20_000, **changes
    )


def check(buffer):
    leaf = (errors + 1e-8) ** 0.7
    sample = buffer.sample()
    expected = 20_000 * leaf / leaf.sum()
    counts = torch.bincount(sample["x"], minlength=8)
    chi_square = ((counts - expected) ** 2 / expected).sum()
    assert chi_square < 24.3, chi_square  # 0.999 quantile for 7 degrees of freedom
    weight = (leaf / leaf.min())[sample["x"]] ** -0.5
    torch.testing.assert_close(sample["priority_weight"], weight, rtol=1e-4, atol=0)


errors = torch.linspace(0.1, 2.0, 8)
buffer = make()
buffer.extend(TensorDict({"x": torch.arange(8)}, [8]))
sample = buffer.sample()
sample["td_error"] = errors[sample["x"]]
buffer.update_tensordict_priority(sample)
check(buffer)
buffer.dumps("buffer")
other = make()
other.loads("buffer")
check(other)
third = make()
third.load_state_dict(buffer.state_dict())
check(third)
"""


def test_prioritised_buffers_of_torchrl_work_after_one_call_and_not_by_an_import(tmp_path):
    done = run_script(tmp_path, OF_TORCHRL)
    assert "C++" not in done.stdout + done.stderr  # TorchRL's warning of its trees


def test_samplers_of_torchrl_are_loaded_fast(tmp_path):
    """They set single leaves: 20,000 take six seconds if each is an array operation."""
    sampler, other = (PrioritizedSampler(20_000, alpha=0.7, beta=0.5) for _ in range(2))
    sampler.update_priority(torch.arange(18_000), torch.rand(18_000))
    sampler.dumps(tmp_path)
    start = time.process_time()
    other.loads(tmp_path)
    assert time.process_time() - start < 2
    everything = torch.arange(20_000)
    for name in ("_sum_tree", "_min_tree"):
        first, second = getattr(sampler, name), getattr(other, name)
        assert torch.equal(torch.as_tensor(first[everything]), torch.as_tensor(second[everything]))
        assert first.query(0, 14_000) == second.query(0, 14_000)


def make(flags, bonus=1.0, seed=0, capacity=None, batch_size=4000, **settings):
    """A buffer of small transitions whose expert flags are given."""
    capacity = capacity or len(flags)
    sampler = ExpertPrioritizedSampler(
        capacity,
        expert_bonus=bonus,
        **settings,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity),
        sampler=sampler,
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )
    buffer.extend(transitions(flags))
    return buffer, sampler


def transitions(flags):
    flags = torch.tensor(flags)[:, None]
    return TensorDict({keys.IS_DEMONSTRATION: flags, "x": torch.arange(len(flags))}, [len(flags)])


FLAGS = [True, False, True, False, False, True, False, False]
ERRORS = [0.0, 0.1, 0.3, 2.0, 0.5, 0.9, 0.05, 1.0]


def formula(errors, flags, bonus, alpha=0.6):
    return np.array([(e + EPS + bonus * f) ** alpha for e, f in zip(errors, flags, strict=True)])


@pytest.mark.parametrize("bonus", [1.0, 0.0, 2.5])
def test_draws_and_weights_follow_the_formula(bonus):
    buffer, sampler = make(FLAGS, bonus)
    sampler.anneal(0.5)
    assert sampler.beta == pytest.approx(0.7)
    update = TensorDict({"index": torch.arange(8), "td_error": torch.tensor(ERRORS)[:, None]}, [8])
    buffer.update_tensordict_priority(update)
    leaf = formula(ERRORS, FLAGS, bonus)
    probability = leaf / leaf.sum()
    draws = torch.cat([buffer.sample()["x"] for _ in range(10)])
    counts = np.bincount(draws.numpy(), minlength=8)
    expected = len(draws) * probability
    chi_square = ((counts - expected) ** 2 / expected)[expected > 5].sum()
    assert chi_square < 24.3  # 0.999 quantile for 7 degrees of freedom
    sample = buffer.sample()
    weights = (leaf / leaf.min()) ** -0.7
    assert sample["priority_weight"].dtype == torch.float32
    assert sample["priority_weight"].shape == (4000,)
    assert sample["priority_weight"].numpy() == pytest.approx(weights[sample["x"]], rel=1e-5)
    # The same up to a factor as the textbook's (N P)^-beta, whose largest is then one.
    textbook = (8 * probability) ** -0.7
    assert weights == pytest.approx(textbook / textbook.max(), rel=1e-9)


@pytest.mark.parametrize(("beta", "expected"), [(0.0, [0] * 5), (0.4, [0.4, 0.7, 1.0, 1.0, 0.4])])
def test_the_exponent_of_the_weights_increases_to_one_except_from_zero(beta, expected):
    buffer, sampler = make(FLAGS, beta=beta)
    buffer.update_priority(torch.arange(8), torch.tensor(ERRORS))
    found = []
    for fraction in (0.0, 0.5, 1.0, 3.0, -1.0):
        sampler.anneal(fraction)
        found.append(sampler.beta)
        is_one = bool((buffer.sample()["priority_weight"] == 1).all())
        assert is_one == (beta == 0)
    assert found == pytest.approx(expected)


def leaves(sampler, n):
    return np.asarray(sampler._sum_tree[torch.arange(n)])


def test_a_single_draw_has_one_index_and_one_weight():
    buffer, sampler = make(FLAGS)
    index, info = sampler.sample(buffer.storage, 1)
    assert index.shape == info["priority_weight"].shape == (1,)
    one, _ = make([True], capacity=1, batch_size=1)
    assert one.sample()["x"].shape == (1,)


def test_new_transitions_get_the_largest_priority_of_the_updates():
    """Before the first update it is one; the bonus of a demonstration counts."""
    buffer, sampler = make([True, False], capacity=10)
    assert leaves(sampler, 2).tolist() == [1.0, 1.0]
    buffer.update_priority(torch.tensor([0, 1]), torch.tensor([0.1, 0.5]))
    buffer.extend(transitions([False, True]))
    new = 1.100001**0.6
    assert new == pytest.approx(1.06, abs=2e-3)
    assert leaves(sampler, 4) == pytest.approx([new, 0.500001**0.6, new, new])
    buffer.update_priority(torch.tensor([2, 3]), torch.tensor([2.0, 0.05]))
    buffer.extend(transitions([True]))
    assert leaves(sampler, 5)[2:] == pytest.approx([2.000001**0.6, 1.050001**0.6, 2.000001**0.6])
    buffer, sampler = make([False], capacity=10)
    buffer.update_priority(torch.tensor([0]), torch.tensor([0.05]))
    buffer.extend(transitions([False]))
    assert leaves(sampler, 2) == pytest.approx([0.050001**0.6, 1.0])  # at least one


@pytest.mark.parametrize("method", ["extend", "add"])
def test_the_largest_priority_does_not_grow_by_a_bonus_per_insertion(method):
    buffer, sampler = make([True] * 4, bonus=1.0, capacity=16, batch_size=4)
    for i in range(200):
        new = transitions([i % 2 == 0])
        getattr(buffer, method)(new if method == "extend" else new[0])
        sample = buffer.sample()
        sample["td_error"] = torch.full((4, 1), 0.2)
        buffer.update_tensordict_priority(sample)
    assert sampler.state_dict()["max_priority"][0] == pytest.approx(1.2 + EPS)
    assert leaves(sampler, 16).max() == pytest.approx((1.2 + EPS) ** 0.6)


def test_transitions_without_an_error_have_the_priority_of_new_ones():
    """As in a buffer of a storage that is not empty, and in an update without ``td_error``."""
    buffer, sampler = make([True, False], capacity=4)
    buffer.update_priority(torch.tensor([0, 1]), torch.tensor([0.1, 0.5]))
    buffer.update_tensordict_priority(TensorDict({"index": torch.arange(2)}, [2]))
    assert leaves(sampler, 2) == pytest.approx([(1.1 + EPS) ** 0.6] * 2)
    other = ExpertPrioritizedSampler(4)
    TensorDictReplayBuffer(storage=buffer.storage, sampler=other, batch_size=2)
    assert leaves(other, 4).tolist() == [1.0, 1.0, 0.0, 0.0]


def test_an_overwritten_transition_has_the_priority_of_a_new_one():
    buffer, sampler = make([True, True], capacity=2)
    buffer.update_priority(torch.tensor([0, 1]), torch.tensor([0.1, 0.3]))
    buffer.extend(transitions([False]))
    assert leaves(sampler, 2) == pytest.approx([(1.3 + EPS) ** 0.6] * 2)


def test_draws_do_not_touch_global_generators():
    one, _ = make(FLAGS, seed=3)
    two, _ = make(FLAGS, seed=3)
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first = one.sample()["x"]
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert (np.random.get_state()[1] == numpy_state).all()  # noqa: NPY002
    torch.manual_seed(99)
    assert torch.equal(two.sample()["x"], first)
    other, _ = make(FLAGS, seed=4)
    assert not torch.equal(other.sample()["x"], first)


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_restored_sampler_continues_the_same_draws(on_disk, tmp_path):
    buffer, sampler = make(FLAGS, capacity=12)
    sampler.anneal(0.25)
    buffer.update_priority(torch.arange(8), torch.tensor(ERRORS))
    sampler.alpha = 0.5  # as by a scheduler of TorchRL
    assert leaves(sampler, 8) == pytest.approx(formula(ERRORS, FLAGS, 1.0, alpha=0.5))
    buffer.sample()
    state = copy.deepcopy(sampler.state_dict())
    draws = torch.Generator().set_state(buffer._rng.get_state())
    if on_disk:
        write_state(tmp_path, state)
        state = read_state(tmp_path)
    expected = buffer.sample()
    other, restored = make(FLAGS, capacity=12, seed=77)
    restored.load_state_dict(state)
    other.set_rng(draws)
    actual = other.sample()
    assert torch.equal(actual["x"], expected["x"])
    assert torch.equal(actual["priority_weight"], expected["priority_weight"])
    largest, place = restored.state_dict()["max_priority"]
    assert (largest, place) == sampler.state_dict()["max_priority"]
    assert largest == pytest.approx(2.0 + EPS)
    assert repr(restored) == repr(sampler)
    assert "alpha=0.5, beta=0.55, eps=1e-06, expert_bonus=1.0" in repr(sampler)
    _, wrong = make(FLAGS)
    with pytest.raises(ValueError, match="capacity"):
        wrong.load_state_dict(state)


def test_invalid_arguments_are_refused():
    buffer, sampler = make(FLAGS)
    with pytest.raises(ValueError, match="3 priorities for 2 indices"):
        buffer.update_priority(torch.arange(2), torch.rand(3))
    with pytest.raises(ValueError, match="not finite"):
        buffer.update_priority(torch.tensor([0]), torch.tensor([float("nan")]))
    with pytest.raises(ValueError, match="storage"):
        sampler.update_priority(torch.tensor([0]), 1.0)
    with pytest.raises(ValueError, match=r"more than max_capacity=\d+ transitions: give"):
        sampler.mark_update(torch.arange(len(FLAGS) + 1))
    with pytest.raises(ValueError, match="eps"):
        ExpertPrioritizedSampler(4, eps=0)
    empty = ExpertPrioritizedSampler(4)
    with pytest.raises(RuntimeError, match="empty"):
        empty.sample(LazyTensorStorage(4), 2)
    buffer.set_sampler(ExpertPrioritizedSampler(8))
    with pytest.raises(RuntimeError, match="have no priorities: pass the sampler when"):
        buffer.sample()


def test_the_bonus_in_a_storage_of_two_dimensions_is_that_of_the_experts():
    sampler = ExpertPrioritizedSampler(6, alpha=1.0, expert_bonus=1e6)
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(6, ndim=2),
        sampler=sampler,
        batch_size=200,
        generator=torch.Generator().manual_seed(0),
    )
    is_demonstration = torch.zeros(2, 3, 1, dtype=torch.bool)
    is_demonstration[1, 2] = True
    rb.extend(
        TensorDict(
            {"number": torch.arange(6).reshape(2, 3), "is_demonstration": is_demonstration}, [2, 3]
        )
    )
    batch = rb.sample()
    assert set(batch["number"].tolist()) == set(range(6))  # new ones have the same priority
    batch["td_error"] = torch.ones(200)
    rb.update_tensordict_priority(batch)
    assert set(rb.sample()["number"].tolist()) == {5}
