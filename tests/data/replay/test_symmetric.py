import pytest
import torch
from tensordict import TensorDict

from ba_torchrl.data.replay.codecs import HalfPrecision
from ba_torchrl.data.replay.make import make_replay

CODEC = HalfPrecision(0.25)


def transitions(numbers, is_demonstration):
    """Transitions whose action and images have the value of their number."""
    count = len(numbers)
    value = torch.tensor(numbers, dtype=torch.float32)

    def image(offset, size):
        return (value / 1024 + offset).reshape(-1, 1, 1, 1).expand(-1, 1, size, size).clone()

    flag = torch.zeros(count, 1, dtype=torch.bool)
    return TensorDict(
        {
            "heightmap": image(0.0, 8),
            "in_hand": image(0.01, 4),
            "holding": flag,
            "action": value[:, None],
            "is_demonstration": flag | is_demonstration,
            "next": {
                "heightmap": image(0.02, 8),
                "in_hand": image(0.03, 4),
                "holding": flag,
                "reward": torch.zeros(count, 1),
                "done": flag,
                "terminated": flag,
                "truncated": flag,
                "fault": flag,
            },
        },
        batch_size=[count],
    )


def replay(capacity=100, batch_size=8, seed=0):
    codecs = {"heightmap": CODEC, "in_hand": CODEC}
    return make_replay("symmetric", capacity, batch_size, codecs=codecs, seed=seed)


def filled(**settings):
    made = replay(**settings)
    made.extend(transitions(range(10), True))
    made.extend(transitions(range(50, 90), False))
    return made


def test_a_batch_of_odd_size_has_one_demonstration_more():
    assert filled(batch_size=7).sample()["is_demonstration"].sum() == 4


@pytest.mark.parametrize("is_demonstration", [True, False])
def test_one_side_fills_the_batch_while_the_other_is_empty(is_demonstration):
    made = replay()
    made.extend(transitions(range(5), is_demonstration))
    assert (made.sample()["is_demonstration"] == is_demonstration).all()
    assert made.sample().batch_size == (8,)


def test_each_side_is_drawn_uniformly_by_its_own_generator():
    made = replay(seed=3)
    made.extend(transitions(range(4), True))
    made.extend(transitions(range(50, 60), False))
    made.extend(transitions(range(4, 9), True))
    expert, online = (torch.Generator().manual_seed(seed) for seed in (6, 7))
    for _ in range(5):
        expected = torch.randint(9, (4,), generator=expert).tolist()
        expected += (50 + torch.randint(10, (4,), generator=online)).tolist()
        assert made.sample()["action"].flatten().tolist() == expected


def test_the_seed_determines_the_draws_and_a_saved_replay_continues_them(tmp_path):
    first, same, other = filled(seed=1), filled(seed=1), filled(seed=2)
    batch = first.sample()["action"]
    assert torch.equal(batch, same.sample()["action"])
    assert not torch.equal(batch, other.sample()["action"])
    first.dumps(tmp_path)
    restored = replay(seed=5)
    restored.loads(tmp_path)
    assert len(restored) == len(first)
    for _ in range(3):
        assert torch.equal(first.sample()["action"], restored.sample()["action"])
    numbers = {int(n) for _ in range(200) for n in restored.sample()["action"]}
    assert numbers == {*range(10), *range(50, 90)}
