"""Collection in worker processes of this machine."""

import itertools
import multiprocessing
import os
import signal
import time
from unittest.mock import Mock

import pytest
import torch
from tensordict import TensorDict

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.vector.batching import SerialVectorEnv
from ba_torchrl.envs.vector.parallel import VectorEnv
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.tasks.close_loop.block_reaching import BlockReaching
from ba_torchrl.training.collectors import multi, workers
from ba_torchrl.training.collectors.workers import VERSION
from ba_torchrl.training.experiment import Experiment
from tests.training.collectors.runs import (
    assert_each_transition_once,
    change_weights,
    config_for,
    own_actions,
    start,
)
from tests.training.test_resume import interrupt

KINDS = ("multi_sync", "multi_async")
SLOW = pytest.mark.slow


@pytest.fixture
def collecting(tmp_path):
    """Start collections, which end with the test."""
    started = []

    def of(name, workers=2, **changes):
        options = {} if name == "single" else {"workers": workers}
        collection, learner = start(config_for(tmp_path, {"name": name, **options}, **changes))
        started.append(collection)
        return collection, learner

    yield of
    for collection in started:
        collection.close()


@SLOW
@pytest.mark.parametrize("name", KINDS)
def test_workers_execute_a_part_of_each_chunk(collecting, name):
    collection, _ = collecting(name, algorithm={"name": "flow_dagger", "batch_size": 8})
    episodes = assert_each_transition_once([next(collection) for _ in range(5)])
    pairs = [pair for steps in episodes.values() for pair in itertools.pairwise(steps)]
    assert pairs
    for before, after in pairs:
        first, second = (step[keys.CARRIED, keys.ACTION_CHUNK] for step in (before, after))
        is_second_part = bool(after[keys.STEP_COUNT] % 2)
        assert torch.equal(first[1:], second[:-1]) == is_second_part
        assert torch.equal(after[keys.ACTION], second[0])


def test_environments_of_a_worker_step_in_its_process_by_default(collecting, monkeypatch):
    monkeypatch.setattr("ba_torchrl.envs.vector.make.available_cores", lambda: 16)
    collection, _ = collecting("multi_sync", num_envs=6, parallel=None)
    for num_envs, kind in ((3, SerialVectorEnv), (6, VectorEnv)):  # a worker's share, all
        env = collection.problem.make_env(num_envs, 0)
        try:
            assert type(env) is kind
        finally:
            env.close()


@pytest.mark.parametrize("kind", KINDS)
def test_every_transition_is_returned_once_and_workers_get_the_weights(kind, collecting):
    collection, learner = collecting(kind)
    learner.policy.beta.fill_(1.0)
    size = {"multi_sync": 4, "multi_async": 2}[kind]
    batches = [next(collection) for _ in range(4)]
    if kind == "multi_async":
        time.sleep(2.5)  # workers do not discard a batch that the learner takes late
    batches += [next(collection) for _ in range(4)]
    assert {len(batch) for batch in batches} == {size}
    assert set(torch.cat([batch[keys.ENV_INDEX] for batch in batches]).tolist()) == set(range(4))
    for batch in batches:  # beta is one of the weights
        assert torch.allclose(batch[keys.ACTION], batch[keys.EXPERT_ACTION], atol=1e-6)

    change_weights(learner, updates=3)
    later = []
    for _ in range(6):
        later.append(next(collection))
        if collection.scalars["lag"] == 0:
            break
    # a worker of an asynchronous collector is one batch ahead, which may wait in the queue
    assert len(later) == 1 if kind == "multi_sync" else len(later) <= 4
    assert torch.allclose(later[-1][keys.ACTION], own_actions(learner, later[-1]), atol=1e-6)
    assert_each_transition_once([*batches, *later])
    assert collection.scalars["restarts"] == 0


def test_workers_start_the_episodes_of_the_default_collector(collecting):
    single, _ = collecting("single")
    sync, _ = collecting("multi_sync")
    expected, found = next(single), next(sync)
    assert len(found[keys.DEPTH].flatten(1).unique(dim=0)) == 4
    assert torch.equal(found[keys.DEPTH], expected[keys.DEPTH])


def test_several_steps_per_batch(tmp_path):
    options = {"name": "multi_sync", "workers": 2, "steps_per_batch": 7}
    collection, _ = start(config_for(tmp_path, options))
    try:
        batches = [next(collection) for _ in range(2)]
    finally:
        collection.close()
    assert {len(batch) for batch in batches} == {28}
    assert_each_transition_once(batches)


def test_workers_draw_different_exploration(collecting):
    collection, _ = collecting("multi_sync", num_envs=2, algorithm={"name": "sac"})
    observed = next(collection)
    assert not torch.equal(*observed[keys.ACTION])


@pytest.mark.parametrize("kind", KINDS)
def test_ended_workers_are_replaced_with_the_present_weights(kind, collecting):
    collection, learner = collecting(kind)
    before = [next(collection) for _ in range(3)]
    change_weights(learner, updates=5)
    pids = collection.worker_pids
    os.kill(pids[0], signal.SIGKILL)
    after = []
    deadline = time.monotonic() + 240
    while not collection.scalars["restarts"] and time.monotonic() < deadline:
        after.append(next(collection))
    assert collection.scalars == {"restarts": 1, "lag": 0.0}
    assert not set(pids) & set(collection.worker_pids)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)
    new = [after[-1], *(next(collection) for _ in range(4))]
    assert torch.allclose(new[0][keys.ACTION], own_actions(learner, new[0]), atol=1e-6)
    assert_each_transition_once(new)
    first = torch.cat([batch[keys.DEPTH] for batch in before])
    assert not (new[0][keys.DEPTH][:, None] == first[None]).flatten(2).all(2).any()


@pytest.mark.parametrize("kind", ["multi_sync", pytest.param("multi_async", marks=SLOW)])
def test_workers_that_hang_are_replaced_after_the_timeout(kind, collecting):
    collection, _ = collecting(kind, timeout_s=6.0)
    for _ in range(3):
        next(collection)
    pids = collection.worker_pids
    os.kill(pids[0], signal.SIGSTOP)
    deadline = time.monotonic() + 240
    while not collection.scalars["restarts"]:
        assert time.monotonic() < deadline
        next(collection)
    assert collection.scalars["restarts"] == 1
    assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)


@pytest.mark.parametrize("kind", ["multi_async", pytest.param("multi_sync", marks=SLOW)])
def test_an_error_of_a_task_is_raised_and_workers_do_not_restart(
    kind, collecting, monkeypatch, tmp_path
):
    evaluate, is_wrong = BlockReaching.evaluate, tmp_path / "wrong"

    def evaluate_or_raise(task):
        if is_wrong.exists():
            if is_wrong.read_text() == str(os.getpid()):
                raise IndexError("no such block")
            time.sleep(2)  # the other worker is alive when the end of this one is noticed
        return evaluate(task)

    monkeypatch.setattr(BlockReaching, "evaluate", evaluate_or_raise)
    collection, _ = collecting(kind)
    next(collection)
    is_wrong.write_text(str(collection.worker_pids[0]))
    with pytest.raises(IndexError, match="no such block") as raised:
        list(itertools.islice(collection, 9))
    assert "in evaluate_or_raise" in str(raised.value.__cause__)
    assert collection.scalars["restarts"] == 0


def test_workers_that_hang_at_their_start_are_killed(collecting, monkeypatch):
    monkeypatch.setattr(multi, "_prepare_worker", lambda _: os.kill(os.getpid(), signal.SIGSTOP))
    with pytest.raises((RuntimeError, OSError)):
        collecting("multi_sync", start_timeout_s=1.0, timeout_s=1.0)
    assert not multiprocessing.active_children()


class FailingCollector:
    """A collector without processes; the second and the third one do not start, and the
    first one loses its workers."""

    procs = ()
    count = 0

    def __init__(self, *_, **__):
        type(self).count += 1
        if self.count in (2, 3):
            raise RuntimeError("no start")

    def __iter__(self):
        if self.count == 1:
            raise EOFError
        yield "batch"

    def update_policy_weights_(self, weights):
        assert weights is not None

    def shutdown(self, **_):
        pass


@pytest.mark.parametrize(("max_restarts", "starts"), [(3, 4), (2, 3)])
def test_a_start_that_fails_is_a_failure_in_a_row(max_restarts, starts, tmp_path, monkeypatch):
    monkeypatch.setattr(FailingCollector, "count", 0)
    monkeypatch.setattr(multi, "MultiSyncCollector", FailingCollector)
    collector = {"name": "multi_sync", "workers": 2}
    collection, _ = start(config_for(tmp_path, collector, max_restarts=max_restarts))
    if starts == 4:
        assert collection.collect() == "batch"
    else:
        with pytest.raises(RuntimeError, match="failed 3 times in a row; the last time: no start"):
            collection.collect()
    assert FailingCollector.count == starts
    collection.close()


@pytest.mark.parametrize("done", [True, False])
def test_failures_add_up_until_an_episode_is_undisturbed(done, tmp_path, monkeypatch):
    flags = {keys.DONE: torch.tensor([[done]]), keys.FAULT: torch.zeros(1, 1, dtype=torch.bool)}
    batch = TensorDict({VERSION: torch.zeros(1, 1), keys.NEXT: flags}, [1])

    class EndsAfterABatch(FailingCollector):
        count = 4

        def __iter__(self):
            yield batch.clone()
            raise EOFError("the end")

    monkeypatch.setattr(workers, "MAX_CONSECUTIVE_FAULTS", 3)
    monkeypatch.setattr(multi, "MultiSyncCollector", EndsAfterABatch)
    options = {"name": "multi_sync", "workers": 2}
    collection, _ = start(config_for(tmp_path, options, max_restarts=1))
    if done:
        assert len(list(itertools.islice(collection, 6))) == 6
        assert collection.scalars["restarts"] == 5
    else:
        with pytest.raises(RuntimeError, match="failed 3 times in a row; the last time: the end"):
            list(itertools.islice(collection, 6))
    collection.close()


def test_an_error_of_the_learners_weights_is_not_one_of_the_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(FailingCollector, "count", 0)
    monkeypatch.setattr(multi, "MultiSyncCollector", FailingCollector)
    collection, _ = start(config_for(tmp_path, {"name": "multi_sync", "workers": 2}))
    monkeypatch.setattr(collection, "weights", Mock(side_effect=RuntimeError("no memory")))
    with pytest.raises(RuntimeError, match=r"^no memory$"):
        collection.collect()
    assert collection.scalars["restarts"] == 0
    collection.close()


def test_too_many_failures_in_a_row_end_the_collection(collecting):
    collection, _ = collecting("multi_sync", max_restarts=0)
    next(collection)
    os.kill(collection.worker_pids[1], signal.SIGKILL)
    with pytest.raises(RuntimeError, match=r"failed 1 times in a row.*max_restarts"):
        next(collection)


def test_a_run_keeps_the_ratio_of_updates_to_steps_and_its_statistics(tmp_path):
    options = {"name": "multi_async", "workers": 2}
    experiment = Experiment(config_for(tmp_path, options), progress=False)
    result = experiment.run()
    assert result.updates == 12
    steps = experiment.state.env_steps
    assert 4 * 12 <= steps <= 4 * 12 + 4  # one update for each step of all four environments
    storage = experiment.learner.replay.storage
    is_demonstration = storage.column("is_demonstration")
    assert len(experiment.learner.replay) == int(is_demonstration.sum()) + steps
    assert len(experiment.state.recent) >= 4  # episodes of at most five steps
    scalars = read_scalars(tmp_path / "run")
    assert scalars["collector/lag"].values[-1] <= 3
    assert scalars["collector/restarts"].values[-1] == 0


def test_a_stopped_run_continues_with_other_episodes(tmp_path):
    options = {"name": "multi_sync", "workers": 2}
    interrupt(config_for(tmp_path, options), after=4)
    result = Experiment(config_for(tmp_path, options, resume=True), progress=False).run()
    assert result.updates == 12
    other = {"name": "multi_sync", "workers": 4}  # may change; the kind may not
    resumed = config_for(tmp_path, other).resolved()
    assert resumed == config_for(tmp_path, options).resolved()
    assert resumed["collector"] == {"name": "multi_sync", "steps_per_batch": 1}


def test_impossible_options_are_refused_before_anything_starts(tmp_path):
    with pytest.raises(ConfigError, match="3 workers cannot share num_envs=4"):
        config_for(tmp_path, {"name": "multi_sync", "workers": 3})
    with pytest.raises(ConfigError, match="unknown collector 'multi'"):
        config_for(tmp_path, {"name": "multi"})
    with pytest.raises(ConfigError, match=r"(?s)collector .*unknown parameter 'steps'"):
        config_for(tmp_path, {"name": "multi_sync", "steps": 3})
