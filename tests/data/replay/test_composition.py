"""Each sampler, writer and storage of the replay with those of TorchRL."""

import copy
import itertools
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import MultiSyncCollector
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import samplers, storages, writers
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.envs import GymEnv

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.codecs import DepthQuantizer
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.segment_tree import use_python_segment_trees
from ba_torchrl.data.replay.storage import FrameStorage
from ba_torchrl.data.replay.symmetric import SymmetricSampler
from ba_torchrl.data.replay.writer import ExpertKeepingWriter
from tests.specs import slow_except

use_python_segment_trees()

SIZE = 16
CODECS = {"image": DepthQuantizer(0.32)}
STORAGES = {
    "CompressedListStorage": storages.CompressedListStorage,
    "LazyMemmapStorage": storages.LazyMemmapStorage,
    "LazyStackStorage": storages.LazyStackStorage,
    "LazyTensorStorage": storages.LazyTensorStorage,
    "ListStorage": storages.ListStorage,
    "FrameStorage": partial(FrameStorage, codecs=CODECS),
}
WRITERS = {
    "RoundRobinWriter": writers.RoundRobinWriter,
    "TensorDictMaxValueWriter": partial(writers.TensorDictMaxValueWriter, rank_key="number"),
    "TensorDictRoundRobinWriter": writers.TensorDictRoundRobinWriter,
    "ExpertKeepingWriter": ExpertKeepingWriter,
}
SAMPLERS = {
    "RandomSampler": samplers.RandomSampler,
    "PrioritizedSampler": partial(samplers.PrioritizedSampler, SIZE, 0.6, 0.4),
    "ExpertPrioritizedSampler": partial(ExpertPrioritizedSampler, SIZE),
    "SymmetricSampler": partial(SymmetricSampler, 0),
}
OURS = {"FrameStorage", "ExpertKeepingWriter", "ExpertPrioritizedSampler", "SymmetricSampler"}
WITHOUT_FILES = {"CompressedListStorage", "LazyStackStorage", "ListStorage"}
"""TorchRL writes no nested tensordict of these into files."""
ROWS = [row for row in itertools.product(STORAGES, WRITERS, SAMPLERS) if OURS & {*row}]
PAIRS = [
    (storage, writer, list(SAMPLERS)[(i + j) % len(SAMPLERS)])
    for i, storage in enumerate(STORAGES)
    for j, writer in enumerate(WRITERS)
]
"""Every two parts together once."""


def transitions(count, start=0):
    """Transitions whose entries are functions of their number; every third is a demonstration."""
    number = torch.arange(start, start + count)
    last = (number % 4 == 3)[:, None]

    def image(of):
        return (of / 1000)[:, None, None, None].expand(-1, 1, 4, 4).clone()

    return TensorDict(
        {
            "image": image(number),
            "number": number,
            "episode": number // 4,
            "step": number % 4,
            keys.IS_DEMONSTRATION: (number % 3 == 0)[:, None],
            keys.NEXT: {
                "image": image(number + 1),
                keys.REWARD: number[:, None].float(),
                keys.DONE: last,
                keys.TRUNCATED: torch.zeros_like(last),
            },
        },
        [count],
    )


def assert_consistent(batch):
    assert torch.equal(batch[keys.NEXT, keys.REWARD][..., 0], batch["number"].float())
    assert torch.equal(batch[keys.IS_DEMONSTRATION][..., 0], batch["number"] % 3 == 0)
    for key, number in [("image", batch["number"]), ((keys.NEXT, "image"), batch["number"] + 1)]:
        error = batch[key] - (number / 1000)[..., None, None, None]
        assert error.abs().max() < 1e-3, key


@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized")
@pytest.mark.parametrize(
    "kind", [pytest.param(ReplayBuffer, marks=pytest.mark.slow), TensorDictReplayBuffer]
)
@pytest.mark.parametrize(("storage", "writer", "sampler"), slow_except(ROWS, PAIRS))
def test_parts_compose(storage, writer, sampler, kind, tmp_path):
    def make(seed):
        return kind(
            storage=STORAGES[storage](SIZE),
            writer=WRITERS[writer](),
            sampler=SAMPLERS[sampler](),
            batch_size=8,
            generator=torch.Generator().manual_seed(seed),
        )

    buffer = make(1)
    for row in transitions(3):
        buffer.add(row)
    for start, count in [(3, 8), (11, 3), (14, 9)]:
        buffer.extend(transitions(count, start))
    stored = [int(buffer.storage[i]["number"]) for i in range(len(buffer))]
    kept = [*range(0, 23, 3), *(n for n in range(11, 23) if n % 3)]
    assert sorted(stored) == sorted(kept if writer == "ExpertKeepingWriter" else range(7, 23))
    batch = buffer.sample()
    assert batch.batch_size == (8,)
    assert_consistent(batch)
    if sampler == "SymmetricSampler":
        assert batch[keys.IS_DEMONSTRATION].sum() == 4
    if "Prioritized" in sampler:
        error = torch.arange(SIZE) / 10
        buffer.update_priority(torch.arange(SIZE), error)
        if sampler == "ExpertPrioritizedSampler":
            bonus = torch.tensor([number % 3 == 0 for number in stored])
            leaves = buffer.sampler.state_dict()["leaves"]
            assert torch.equal(leaves, (error.double() + 1e-6 + bonus.double()) ** 0.6)
        if kind is TensorDictReplayBuffer:
            batch[keys.TD_ERROR] = torch.rand(8, 1)
            buffer.update_tensordict_priority(batch)
    if storage not in WITHOUT_FILES:
        buffer.dumps(tmp_path / "buffer")
        restored = make(2)
        restored.loads(tmp_path / "buffer")
        assert_continues(restored, copy.deepcopy(buffer))
    else:
        with pytest.raises((NotImplementedError, TypeError)):  # by TorchRL
            buffer.dumps(tmp_path / "buffer")
    if writer == "TensorDictMaxValueWriter":
        with pytest.raises(NotImplementedError):  # by TorchRL
            buffer.state_dict()
        return
    restored = make(2)
    restored.load_state_dict(copy.deepcopy(buffer.state_dict()))
    buffer.load_state_dict(buffer.state_dict())
    assert_continues(restored, buffer)


def assert_continues(restored, buffer):
    for start in (40, 50):
        one, two = restored.sample(), buffer.sample()
        assert torch.equal(one["number"], two["number"])
        assert_consistent(one)
        for each in (restored, buffer):
            each.extend(transitions(2, start))


@pytest.mark.parametrize("writer", ["immutable", "round robin"])
@pytest.mark.parametrize("sampler", ["ExpertPrioritizedSampler", "SymmetricSampler"])
def test_stored_data_are_sampled(sampler, writer):
    buffer = TensorDictReplayBuffer(
        storage=TensorStorage(transitions(SIZE)),
        writer=writers.ImmutableDatasetWriter() if writer == "immutable" else ExpertKeepingWriter(),
        sampler=SAMPLERS[sampler](),
        batch_size=8,
    )
    batch = buffer.sample()
    assert_consistent(batch)
    batch[keys.TD_ERROR] = torch.rand(8)
    buffer.update_tensordict_priority(batch)
    if writer == "immutable":
        with pytest.raises(RuntimeError, match="doesn't allow writing"):
            buffer.extend(transitions(2))
    else:
        assert buffer.extend(transitions(2, 30)).tolist() == [1, 2]


@pytest.mark.parametrize("sampler", ["ExpertPrioritizedSampler", "SymmetricSampler"])
def test_a_storage_of_two_dimensions(sampler):
    storage = LazyTensorStorage(SIZE, ndim=2)
    make = partial(TensorDictReplayBuffer, storage=storage, batch_size=400)
    first = make(sampler=SAMPLERS[sampler]())
    first.extend(transitions(12).reshape(3, 4))
    for buffer in (first, make(sampler=SAMPLERS[sampler]())):  # one of stored data
        batch = buffer.sample()
        assert_consistent(batch)
        assert {*batch["number"].tolist()} == {*range(12)}


@pytest.mark.parametrize("sampler", ["ExpertPrioritizedSampler", "SymmetricSampler"])
def test_an_ensemble_of_replays(sampler):
    members = [
        TensorDictReplayBuffer(
            storage=STORAGES[storage](SIZE),
            writer=ExpertKeepingWriter(),
            sampler=SAMPLERS[sampler](),
        )
        for storage in ("FrameStorage", "LazyTensorStorage")
    ]
    for member in members:
        member.extend(transitions(20))
    ensemble = ReplayBufferEnsemble(*members, batch_size=8, sample_from_all=True)
    batch = ensemble.sample()
    assert batch.shape == (2, 4)
    assert_consistent(batch)
    ensemble.load_state_dict(copy.deepcopy(ensemble.state_dict()))
    assert_consistent(ensemble.sample())


@pytest.mark.parametrize(
    ("sampler", "settings"),
    [
        (partial(samplers.SliceSampler, slice_len=2, traj_key="episode"), {}),
        (partial(samplers.SliceSampler, slice_len=2, end_key=(keys.NEXT, keys.DONE)), {}),
        (partial(samplers.SliceSampler, slice_len=2, end_keys=[(keys.NEXT, keys.DONE)]), {}),
        (
            partial(
                samplers.SliceSampler,
                slice_len=2,
                traj_key="episode",
                fragmented=True,
                step_key="step",
            ),
            {},
        ),
        (partial(samplers.SliceSamplerWithoutReplacement, slice_len=2, traj_key="episode"), {}),
        (
            partial(
                samplers.PrioritizedSliceSampler, SIZE, 0.6, 0.4, slice_len=2, traj_key="episode"
            ),
            {},
        ),
        (partial(ExpertPrioritizedSampler, SIZE), {"sample_unit": Sequence(length=2)}),
    ],
    ids=["traj_key", "end_key", "end_keys", "fragmented", "once", "prioritized", "sequence"],
)
def test_slices_of_trajectories_from_shared_frames(sampler, settings):
    buffer = TensorDictReplayBuffer(
        storage=FrameStorage(SIZE, CODECS), sampler=sampler(), batch_size=8, **settings
    )
    for start in (0, 12):
        buffer.extend(transitions(12, start))
        batch = buffer.sample()
        assert_consistent(batch)
        number, following = batch["number"].reshape(-1, 2).unbind(1)
        at_end = (number % 4 == 3) | (number == following)  # a padded sequence
        assert (at_end | (following == number + 1)).all()
        assert (number // 4 == following // 4).all()


@pytest.mark.parametrize(
    "key",
    ["number", "image", "next", ("next",), ("next", "image"), ("next", keys.DONE), "absent"],
    ids=str,
)
def test_an_entry_is_read_as_from_a_storage_of_torchrl(key):
    found = []
    for storage in (FrameStorage(SIZE, CODECS), LazyTensorStorage(SIZE)):
        storage.set(range(6), transitions(6))
        try:
            found.append(storage.get(key))
        except KeyError as error:
            found.append(str(error).split(" in ")[0])
    ours, theirs = found
    if isinstance(ours, TensorDict):
        assert {*ours.keys()} == {*theirs.keys()}
        ours, theirs = ours["image"], theirs["image"]
    if isinstance(ours, str):
        assert ours == theirs
    else:
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "cursor", [slice(2, 4), [2, 3], range(2, 4), torch.arange(SIZE).clamp(0, 4).eq(3), 3], ids=str
)
def test_items_are_set_as_in_a_storage_of_torchrl(cursor):
    for storage in (frames := FrameStorage(SIZE, CODECS), tensors := LazyTensorStorage(SIZE)):
        storage.set(range(SIZE), transitions(SIZE))
        index = torch.arange(SIZE)[cursor]
        new = transitions(SIZE, 100)[: index.numel()]
        storage[cursor] = new if index.ndim else new[0]
    assert torch.equal(frames[:]["number"], tensors[:]["number"])
    assert_consistent(frames[:])


def test_a_list_of_transitions_is_stored():
    buffer = ReplayBuffer(storage=FrameStorage(SIZE, CODECS), batch_size=4)
    buffer.extend(list(transitions(5)))
    assert len(buffer) == 5
    assert_consistent(buffer[:])


def shared(**parts):
    parts = {"storage": LazyTensorStorage(SIZE, shared_init=True), **parts}
    return TensorDictReplayBuffer(shared=True, **parts)


OBSERVATION = {"observation": DepthQuantizer(0.32)}
REPLAYS = {
    "FrameStorage": lambda: shared(storage=FrameStorage(SIZE, OBSERVATION)),
    "ExpertPrioritizedSampler": lambda: shared(sampler=ExpertPrioritizedSampler(SIZE)),
    "SymmetricSampler": lambda: shared(sampler=SymmetricSampler(0)),
    "make_replay": lambda: make_replay("uniform", SIZE, 4, codecs=OBSERVATION, seed=0),
}


@pytest.mark.parametrize("name", REPLAYS)
def test_a_replay_for_several_processes_is_refused_by_name(name):
    part = "FrameStorage" if name == "make_replay" else name
    env = partial(GymEnv, "CartPole-v1")
    with pytest.raises(RuntimeError, match=f"^{part} cannot be shared .*: collect without"):
        MultiSyncCollector([env], frames_per_batch=4, total_frames=4, replay_buffer=REPLAYS[name]())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: TensorDictReplayBuffer(
                storage=LazyTensorStorage(SIZE, ndim=2), writer=ExpertKeepingWriter()
            ),
            r"a storage of one dimension, got ndim=2; flatten",
        ),
        (
            lambda: FrameReplayBuffer(
                storage=LazyTensorStorage(SIZE),
                sampler=samplers.RandomSampler(),
                batch_size=4,
                generator=torch.Generator(),
            ),
            "needs a FrameStorage; for a LazyTensorStorage, pass the sampler and an Exp",
        ),
    ],
    ids=["writer", "buffer"],
)
def test_what_does_not_compose_is_refused_by_name(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
