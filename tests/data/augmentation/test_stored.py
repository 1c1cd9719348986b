"""Rotated copies that are stored with each transition."""

import torch
from tensordict import TensorDict

from ba_torchrl.data.augmentation.so2 import SO2Augmentation, rotate_images
from ba_torchrl.data.augmentation.stored import StoredCopies
from ba_torchrl.envs import keys
from tests.specs import close_loop_images


def batch(count=3, size=16):
    def pixels():
        return torch.rand(count, 1, size, size) * 0.3

    return TensorDict(
        {
            keys.PIXELS: pixels(),
            keys.ACTION: torch.rand(count, 5) - 0.5,
            "number": torch.arange(count),
            keys.NEXT: {keys.PIXELS: pixels(), keys.REWARD: torch.rand(count, 1)},
        },
        [count],
    )


def test_each_transition_is_followed_by_its_rotated_copies():
    rotation = SO2Augmentation(close_loop_images(16), "pxyzr", seed=0, probability=1.0)
    data = batch()
    out = StoredCopies(rotation, 4)(data)
    assert out["number"].tolist() == [0] * 5 + [1] * 5 + [2] * 5
    for i in range(15):
        original, copy = data[i // 5], out[i]
        assert torch.equal(copy[keys.NEXT, keys.REWARD], original[keys.NEXT, keys.REWARD])
        if i % 5 == 0:
            assert (copy == original).all()
            continue
        old, new = original[keys.ACTION], copy[keys.ACTION]
        assert torch.equal(old[[0, 3, 4]], new[[0, 3, 4]])
        angle = (torch.atan2(new[2], new[1]) - torch.atan2(old[2], old[1]))[None].double()
        turned = rotate_images(original[keys.PIXELS][None], angle)[0]
        torch.testing.assert_close(copy[keys.PIXELS], turned, atol=2e-4, rtol=0)
