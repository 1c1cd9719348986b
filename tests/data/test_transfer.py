"""Batches that are decoded after they were copied."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from ba_torchrl.core import keys
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.replay.codecs import ImageCodecs, make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.transfer import batch_to_device, to_device

CPU, META = torch.device("cpu"), torch.device("meta")
IMAGES = {
    keys.DEPTH: ImageSpec(1, 8, 0.4, storage="uint8"),
    "heights": ImageSpec(1, 8, 0.4, storage="float16"),
    "camera": ImageSpec(3, 8, 255, storage="exact", dtype=torch.uint8),
}
CODECS = make_codecs(IMAGES)


def transitions(count=20):
    generator = torch.Generator().manual_seed(0)

    def state():
        image = torch.rand(count, 1, 8, 8, generator=generator)
        camera = (255 * torch.rand(count, 3, 8, 8, generator=generator)).to(torch.uint8)
        return {keys.DEPTH: 0.4 * image, "heights": 0.3 * image, "camera": camera}

    expert = torch.arange(count)[:, None] % 3 == 0
    action = torch.rand(count, 4, generator=generator)
    data = {**state(), keys.ACTION: action, keys.IS_DEMONSTRATION: expert, keys.NEXT: state()}
    return TensorDict(data, [count])


@pytest.mark.parametrize("kind", ["uniform", "prioritized", "symmetric"])
def test_codes_decoded_after_the_copy_are_the_images_of_the_replay(kind):
    samples = []
    for returns_codes in (False, True):
        replay = make_replay(kind, 50, 8, codecs=CODECS, seed=1, returns_codes=returns_codes)
        replay.extend(transitions())
        samples.append(replay.sample())
    images, codes = samples
    assert codes[keys.DEPTH].dtype == torch.uint8
    assert images[keys.DEPTH].dtype == torch.float32
    kept = codes.clone()
    decoded = ImageCodecs(IMAGES, device=CPU)(codes)
    assert set(decoded.keys(True, True)) == set(images.keys(True, True))
    for key in images.keys(True, True):
        torch.testing.assert_close(decoded[key], images[key], rtol=0, atol=0)
    stored = LazyTensorStorage(50)  # the codec is the replay's, and not the storage's
    replay = ReplayBuffer(storage=stored, transform=ImageCodecs(IMAGES, [*IMAGES]))
    data = transitions()
    replay.extend(data)
    assert data[keys.DEPTH].dtype == torch.float32
    assert stored[:][keys.DEPTH].dtype == stored[:][keys.NEXT, "heights"].dtype == torch.uint8
    assert (stored[:][keys.DEPTH][kept["index"]] == kept[keys.DEPTH]).all()
    assert (replay[kept["index"]] == images.select(*data.keys())).all()


def test_images_go_to_the_device_first_and_the_other_entries_last():
    batch = transitions()
    batch.update({keys.DEPTH: CODECS[keys.DEPTH].encode(batch[keys.DEPTH])})
    batch[keys.NEXT, keys.DEPTH] = batch[keys.DEPTH]
    decoded = ImageCodecs({keys.DEPTH: IMAGES[keys.DEPTH]}, device=META)(batch)
    assert decoded[keys.DEPTH].device == decoded[keys.NEXT, keys.DEPTH].device == META
    assert decoded[keys.ACTION].device == CPU
    moved = batch_to_device(decoded, META)
    assert {value.device for value in moved.values(True, True)} == {META}
    assert moved.device == META


def test_what_is_on_the_device_is_not_copied():
    value = torch.rand(3)
    assert to_device(value, CPU) is value
