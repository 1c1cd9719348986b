import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.replay.codecs import DepthQuantizer
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.replay.writer import ExpertKeepingWriter

QUANTIZER = DepthQuantizer(0.4)


def transitions(numbers, is_demonstration):
    """Transitions whose action is their number."""
    count = len(numbers)
    depth = torch.zeros(count, 1, 4, 4)
    return TensorDict(
        {
            keys.DEPTH: depth,
            keys.ACTION: torch.tensor(list(numbers), dtype=torch.float32)[:, None],
            keys.IS_DEMONSTRATION: torch.full((count, 1), is_demonstration),
            keys.NEXT: {keys.DEPTH: depth.clone()},
        },
        batch_size=[count],
    )


def replay(capacity=64, kind="uniform"):
    return make_replay(kind, capacity, 8, codecs={keys.DEPTH: QUANTIZER}, seed=0)


def numbers_in(made):
    return made.storage.column(keys.ACTION)[:, 0].int().tolist()


@pytest.mark.parametrize("kind", ["uniform", "prioritized", "symmetric"])
def test_demonstrations_are_kept_in_a_full_replay(kind):
    made = replay(kind=kind)
    made.extend(transitions(range(30), True))
    for start in range(100, 200, 5):
        made.extend(transitions(range(start, start + 5), False))
    assert len(made) == 64
    assert sorted(numbers_in(made)) == [*range(30), *range(166, 200)]
    assert made.sample().batch_size == (8,)


def test_demonstrations_that_are_added_later_are_kept():
    made = replay(8)
    made.extend(transitions(range(6), False))
    made.extend(torch.cat([transitions([100], True), transitions([6, 7], False)]))
    made.extend(transitions([101], True))
    for number in range(8, 40):
        made.add(transitions([number], False)[0])
    assert sorted(numbers_in(made)) == [*range(34, 40), 100, 101]


def test_a_batch_that_exceeds_the_capacity_keeps_demonstrations_and_the_newest():
    made = replay(8)
    made.extend(transitions([0, 1], True))
    batch = torch.cat([transitions([2], True), transitions(range(10, 30), False)])
    made.extend(batch)
    assert sorted(numbers_in(made)) == [0, 1, 2, *range(25, 30)]


def test_without_demonstrations_the_oldest_is_overwritten():
    made = replay(8)
    for start in range(0, 30, 3):
        index = made.extend(transitions(range(start, start + 3), False))
        assert index.tolist() == [n % 8 for n in range(start, start + 3)]
    assert sorted(numbers_in(made)) == list(range(22, 30))


def test_demonstrations_that_exceed_the_capacity_are_refused():
    made = replay(8)
    made.extend(transitions(range(6), True))
    with pytest.raises(ConfigError, match="raise the capacity"):
        made.extend(transitions(range(3), True))
    made.extend(transitions([6, 7], True))
    with pytest.raises(ConfigError, match="demonstrations fill the replay of 8 transitions"):
        made.extend(transitions([8], False))


def test_a_restored_replay_keeps_its_demonstrations(tmp_path):
    made, restored = replay(8), replay(8)
    made.extend(transitions(range(3), True))
    made.extend(transitions(range(10, 17), False))
    made.dumps(tmp_path)
    restored.loads(tmp_path)
    for one in (made, restored):
        one.extend(transitions(range(20, 29), False))
        assert sorted(numbers_in(one)) == [0, 1, 2, *range(24, 29)]
    assert numbers_in(made) == numbers_in(restored)


def test_a_slot_that_is_written_again_has_another_generation():
    writer = ExpertKeepingWriter(track_generations=True)
    made = TensorDictReplayBuffer(storage=LazyTensorStorage(4), writer=writer)
    made.extend(torch.cat([transitions([0], True), transitions([1, 2, 3], False)]))
    made.extend(transitions([4, 5], False))
    assert writer.generations_of(torch.arange(4)).tolist() == [0, 1, 1, 0]
