"""The frame-sharing replay: contents, memory, checks, checkpoints."""

import copy
import tracemalloc

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError, ReplaySchemaError
from ba_torchrl.data.replay.codecs import DepthQuantizer
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.storage import FrameStorage, FrameTable
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.demonstrations.collect import collect_demonstrations
from tests.specs import slow_except

QUANTIZER = DepthQuantizer(0.32)


def buffer(capacity=50, batch_size=8, seed=0, kind="prioritized", **settings):
    return make_replay(
        kind, capacity, batch_size, codecs={keys.DEPTH: QUANTIZER}, seed=seed, **settings
    )


def episode(length, rng, size=8, expert=False, truncated=False):
    """Transitions of one episode: the next image of a step is the image of the following one."""
    frames = torch.from_numpy(rng.random((length + 1, 1, size, size), dtype=np.float32) * 0.32)
    holding = torch.from_numpy(rng.random((length + 1, 1)) > 0.5)
    last = torch.arange(length)[:, None] == length - 1
    return TensorDict(
        {
            keys.DEPTH: frames[:-1],
            keys.HOLDING: holding[:-1],
            keys.ACTION: torch.from_numpy(rng.random((length, 5), dtype=np.float32)),
            keys.IS_DEMONSTRATION: torch.full((length, 1), expert),
            keys.NEXT: {
                keys.DEPTH: frames[1:],
                keys.HOLDING: holding[1:],
                keys.REWARD: last.float(),
                keys.TERMINATED: last & (not truncated),
                keys.TRUNCATED: last & truncated,
                keys.DONE: last,
                keys.FAULT: torch.zeros(length, 1, dtype=torch.bool),
            },
        },
        [length],
    )


def assert_same(stored, original):
    for key in (keys.DEPTH, (keys.NEXT, keys.DEPTH)):
        assert stored[key].dtype == torch.float32
        assert (stored[key] - original[key]).abs().max() <= QUANTIZER.max_error_m * 1.001
    for key in (keys.HOLDING, keys.ACTION, keys.IS_DEMONSTRATION, (keys.NEXT, keys.TRUNCATED)):
        assert torch.equal(stored[key], original[key])


def frames_needed(transitions):
    """Number of distinct frames of transitions, by their codes."""
    codes = set()
    for t in transitions:
        for key in (keys.DEPTH, (keys.NEXT, keys.DEPTH)):
            codes.add(QUANTIZER.encode(t[key]).numpy().tobytes())
    return len(codes)


def test_a_plain_episode_shares_its_frames():
    rb, rng = buffer(), np.random.default_rng(0)
    data = episode(10, rng)
    index = rb.extend(data)
    assert index.tolist() == list(range(10))
    assert_same(rb[:], data)
    assert rb.storage.frame_count == 11
    one = rb.storage[3]
    assert one[keys.DEPTH].shape == (1, 8, 8)
    assert_same(one[None], data[3:4])


@pytest.mark.parametrize("capacity", [7, 16, 50])
def test_random_interleavings_and_wrap_around(capacity):
    """Interleave four environments with different episode lengths, and complete episodes."""
    rb, rng = buffer(capacity), np.random.default_rng(1)
    expected = [None] * capacity
    cursor = 0

    def put(batch):
        nonlocal cursor
        places = rb.extend(batch)
        for i, place in enumerate(places.tolist()):
            assert place == (cursor + i) % capacity
            expected[place] = batch[i].clone()
        cursor += len(batch)

    streams = [[] for _ in range(4)]
    for _ in range(40):
        kind = rng.random()
        if kind < 0.15:
            put(episode(int(rng.integers(1, 6)), rng))
        else:
            steps = []
            for stream in streams:
                if rng.random() < 0.2:
                    stream.clear()  # a reset before the end: the chain breaks
                if not stream:
                    stream.extend(episode(int(rng.integers(1, 6)), rng).unbind(0))
                steps.append(stream.pop(0))
            put(torch.stack(steps))
        held = [t for t in expected if t is not None]
        assert len(rb) == len(held)
        assert rb.storage.frame_count == frames_needed(held)
        assert_same(rb[:], torch.stack(held))
    sample = torch.cat([rb.sample() for _ in range(4)])
    assert_same(sample, torch.stack([expected[i] for i in sample["index"].tolist()]))


def test_frame_table_counts_frees_and_reuses():
    table = FrameTable(torch.Size([1, 2, 2]))
    a, b, c, d = (np.full(4, i, dtype=np.uint8) for i in range(4))
    assert [table.acquire(f) for f in (a, b, a, c)] == [0, 1, 0, 2]
    table.release(0)
    assert len(table) == 3
    table.release(0)
    assert len(table) == 2
    assert table.acquire(d) == 0
    assert table.read(torch.tensor([[0, 1]])).tolist() == [[[[[3, 3], [3, 3]]], [[[1, 1], [1, 1]]]]]
    assert table.acquire(a) == 3
    table.clear()
    assert len(table) == table.nbytes == 0
    assert table.acquire(b) == 0


@pytest.mark.parametrize("kind", ["noise", "flat", "ramp"])
def test_any_frame_is_restored_exactly(kind):
    table, rng = FrameTable(torch.Size([1, 128, 128])), np.random.default_rng(4)
    frame = {
        "noise": rng.integers(0, 256, 128 * 128, dtype=np.uint8),
        "flat": np.full(128 * 128, 200, dtype=np.uint8),
        "ramp": (np.arange(128 * 128) // 64).astype(np.uint8),
    }[kind]
    slot = table.acquire(frame)
    assert np.array_equal(table.read(torch.tensor(slot)).numpy().reshape(-1), frame)
    # what does not compress takes hardly more than the frame itself
    assert table.nbytes < 128 * 128 * 1.02 if kind == "noise" else table.nbytes < 1000


def test_counted_bytes_are_those_allocated():
    rng = np.random.default_rng(5)
    frames = rng.integers(0, 256, (20_000, 16), dtype=np.uint8)
    table = FrameTable(torch.Size([16]))
    tracemalloc.start()
    for frame in frames:
        table.acquire(frame)
    allocated, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert allocated == pytest.approx(table.nbytes, rel=0.25)


def test_incompressible_images_fit_as_well():
    """100,000 transitions of 128 px of pure noise take 1.7 GB from 50 steps per episode on."""
    rng = np.random.default_rng(4)
    for length, limit in [(7, 19_200), (50, 17_100)]:
        rb = buffer(200)
        while len(rb) < 150:
            rb.extend(episode(length, rng, size=128))
        assert rb.storage.frame_count == len(rb) + len(rb) // length
        assert rb.storage.nbytes / len(rb) <= limit


@pytest.mark.parametrize(
    "task",
    slow_except(
        [task for task in ba_torchrl.list_tasks() if task.startswith("close_loop")],
        ["close_loop/block_stacking", "close_loop/drawer_opening"],
    ),
)
def test_memory_of_expert_episodes(task):
    """100,000 transitions of 128 px take 0.5 GB at most, also with short episodes."""
    env = ba_torchrl.make_vector_env(task, 1, parallel=False, seed=0, expert=True)
    depth = env.observation_spec[keys.DEPTH]
    quantizer = DepthQuantizer(float(depth.space.high.max()))
    episodes = collect_demonstrations(env, 3, seed=0)
    env.close()
    rb = make_replay("uniform", 200, 8, codecs={keys.DEPTH: quantizer}, seed=0)
    for data in episodes:
        rb.extend(as_transitions(data, ["depth"], is_demonstration=True))
    assert rb.storage.nbytes / len(rb) <= 5_000
    original = torch.cat(episodes)
    for key in (keys.DEPTH, (keys.NEXT, keys.DEPTH)):
        assert torch.equal(rb[:][key], quantizer(original[key]))


@pytest.mark.parametrize("kind", ["uniform", "prioritized", "symmetric"])
def test_samples_are_float_metres_with_an_index(kind):
    rb, rng = buffer(kind=kind), np.random.default_rng(7)
    data = torch.cat([episode(6, rng, expert=True), episode(6, rng)])
    rb.extend(data)
    sample = rb.sample()
    assert sample.batch_size == (8,)
    assert_same(sample, data[sample["index"]])
    assert (keys.NEXT, keys.FAULT) not in sample.keys(True)
    assert ("priority_weight" in sample) == (kind == "prioritized")
    if kind == "prioritized":
        sample[keys.TD_ERROR] = torch.rand(8, 1)
        rb.update_tensordict_priority(sample)
    again = buffer(kind=kind)
    again.extend(data)
    assert torch.equal(again.sample()["index"], sample["index"])
    sample[keys.DEPTH].zero_()  # a sample is a copy
    assert_same(rb[:], data)


def test_faults_never_enter():
    rb, rng = buffer(), np.random.default_rng(9)
    data = episode(6, rng)
    data[keys.NEXT, keys.FAULT][[1, 4]] = True
    before = data.clone()
    assert rb.extend(data).tolist() == [0, 1, 2, 3]
    assert_same(rb[:], data[[0, 2, 3, 5]])
    assert set(data.keys(True)) == set(before.keys(True))  # the caller's data is left alone
    assert rb.extend(data[[1]]).numel() == 0
    assert rb.add(data[4]).numel() == 0
    assert rb.add(data[5]).tolist() == [4]
    assert len(rb) == rb.write_count == 5


def test_transitions_with_another_schema_are_refused():
    rb, rng = buffer(), np.random.default_rng(10)
    data = episode(4, rng)
    rb.extend(data)
    missing = data.exclude(keys.HOLDING)
    extra = data.clone().set("colour", torch.zeros(4))
    other_type = data.clone().set(keys.ACTION, data[keys.ACTION].double())
    other_shape = data.clone().set(keys.DEPTH, torch.zeros(4, 1, 9, 9))
    for bad, words in [
        (missing, "missing 'holding'"),
        (extra, "unexpected 'colour'"),
        (other_type, "float64"),
        (other_shape, "stored as float32"),
        (data.reshape(2, 2), "one batch dimension"),
    ]:
        with pytest.raises(ReplaySchemaError, match=words):
            rb.extend(bad)
    assert len(rb) == 4
    assert_same(rb[:], data)
    with pytest.raises(ReplaySchemaError, match="lack"):
        buffer().extend(data.exclude(keys.DEPTH))
    with pytest.raises(ReplaySchemaError, match=r"a TensorDict .*, not a list"):
        buffer().extend(list(data.unbind(0)))
    unmarked = buffer()
    unmarked.extend(data.exclude(keys.IS_DEMONSTRATION))
    with pytest.raises(ReplaySchemaError, match="lack 'is_demonstration': set this flag"):
        assert unmarked.num_demonstrations
    rb.extend(data.exclude((keys.NEXT, keys.FAULT)))  # the flag is not part of what is stored


def test_a_storage_refuses_images_of_another_shape_and_keeps_what_it_has():
    storage, data = buffer().storage, episode(4, np.random.default_rng(12))
    bigger = torch.zeros(4, 1, 9, 9)
    for bad, words in [
        (data.exclude((keys.NEXT, keys.DEPTH)), r"lack \('next', 'depth'\)"),
        (data.clone().set((keys.NEXT, keys.DEPTH), bigger), r"'depth'\) is float32\[1, 9, 9\]"),
    ]:
        with pytest.raises(ReplaySchemaError, match=words):
            storage.set(range(4), bad)
        with pytest.raises(ReplaySchemaError, match=words):
            buffer().extend(bad)
    storage.set(range(4), data)
    others = data.clone().set(keys.DEPTH, bigger).set((keys.NEXT, keys.DEPTH), bigger)
    with pytest.raises(ReplaySchemaError, match="another shape are stored"):
        storage.set(range(4), others)
    assert_same(storage.get(range(4)), data)
    with pytest.raises(ConfigError, match=r"depth has no codec: pass make_codecs\(images\)"):
        FrameStorage(4, {keys.DEPTH: None})


@pytest.mark.parametrize("how", ["state_dict", "dumps", "Checkpoint"])
def test_checkpoint_round_trip(how, tmp_path):
    rb, rng = buffer(30), np.random.default_rng(11)
    for _ in range(9):  # wrapped, with freed frames
        rb.extend(episode(5, rng, expert=rng.random() < 0.5))
    sample = rb.sample()
    sample[keys.TD_ERROR] = torch.rand(8, 1) * 3
    rb.update_tensordict_priority(sample)
    other = buffer(30, seed=5)
    other.extend(episode(12, rng))  # what it held is replaced
    if how == "state_dict":
        other.load_state_dict(copy.deepcopy(rb.state_dict()))
    elif how == "dumps":
        rb.dumps(tmp_path / "replay")
        other = buffer(30, seed=5)
        other.loads(tmp_path / "replay")
    else:
        Checkpoint(replay_buffer=rb).save(tmp_path / "checkpoint")
        Checkpoint(replay_buffer=other).load(tmp_path / "checkpoint")
    assert_same(other[:], rb[:])
    assert other.storage.frame_count == rb.storage.frame_count
    following = episode(5, rng)
    for b in (rb, other):
        b.extend(following)
    assert_same(other[:], rb[:])
    assert other.storage.frame_count == rb.storage.frame_count
    for _ in range(3):
        one, two = rb.sample(), other.sample()
        assert torch.equal(one["index"], two["index"])
        assert torch.equal(one["priority_weight"], two["priority_weight"])


def test_an_empty_replay_can_be_saved(tmp_path):
    rb = buffer()
    rb.dumps(tmp_path / "replay")
    other = buffer()
    other.loads(tmp_path / "replay")
    assert len(other) == 0
    with pytest.raises(RuntimeError, match="empty"):
        other.sample()


def test_empty_removes_everything():
    rb, rng = buffer(), np.random.default_rng(12)
    rb.extend(episode(5, rng))
    rb.empty()
    assert len(rb) == rb.storage.frame_count == 0
    data = episode(3, rng)
    rb.extend(data)
    assert_same(rb[:], data)


def test_column_reads_flags_without_images(monkeypatch):
    rb, rng = buffer(), np.random.default_rng(13)
    with pytest.raises(KeyError, match="empty"):
        rb.storage.column(keys.IS_DEMONSTRATION)
    rb.extend(torch.cat([episode(2, rng, expert=True), episode(2, rng)]))
    monkeypatch.setattr(FrameTable, "read", lambda *_: pytest.fail("decoded images"))
    assert rb.storage.column(keys.IS_DEMONSTRATION).flatten().tolist() == [True, True, False, False]
    rb.update_priority(torch.arange(4), torch.ones(4))
