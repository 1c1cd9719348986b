"""Random views against index arithmetic."""

import itertools

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError, ConfigError
from ba_torchrl.data.augmentation.views import (
    CenterCrop,
    RandomViews,
    cropped_images,
    take_views,
)
from tests.specs import close_loop_images, from_replay

SIZE = 10


def batch(count=6, size=SIZE):
    """Transitions whose pixels are all different."""
    depth = torch.arange(count * size * size, dtype=torch.float32).reshape(count, 1, size, size)
    holding = torch.arange(count)[:, None] % 2 == 0
    return TensorDict(
        {
            keys.DEPTH: depth,
            keys.HOLDING: holding,
            keys.ACTION: torch.rand(count, 5),
            keys.NEXT: {keys.DEPTH: depth + 0.5, keys.HOLDING: ~holding},
        },
        [count],
    )


def test_every_view_has_the_vectors_of_its_transition():
    data = batch()
    data["proprio"] = torch.rand(6, 8)
    data[keys.NEXT, "proprio"] = torch.rand(6, 8)
    settings = {"views": 2, "target_views": 3, "has_positive": True, "padding": 1}
    out = RandomViews(close_loop_images(SIZE), ["proprio"], seed=0, **settings)(data)
    for key, count in (("proprio", 2), ((keys.NEXT, "proprio"), 3)):
        assert torch.equal(out[key], data[key][:, None].expand(6, count, 8))
    assert torch.equal(out[keys.POSITIVE, "proprio"], data["proprio"])


def views(size=SIZE, **settings):
    return RandomViews(close_loop_images(size), seed=0, **settings)


def offset_of(view, image, padding=0):
    """Return the offset of a view [1, h, h] in an image [1, H, H], by trying all of them."""
    size = view.shape[-1]
    padded = F.pad(image[None], [padding] * 4, mode="replicate")[0, 0]
    starts = itertools.product(range(len(padded) - size + 1), repeat=2)
    (found,) = (
        (row, column)
        for row, column in starts
        if torch.equal(view[0], padded[row : row + size, column : column + size])
    )
    return found


def test_views_are_the_pixels_from_their_offset_on():
    images = torch.rand(2, 3, 5, 5)
    offsets = torch.tensor([[[0, 2], [1, 0]], [[2, 2], [0, 1]]])
    found = take_views(images, offsets, size=3)
    for b in range(2):
        for v in range(2):
            row, column = offsets[b, v].tolist()
            expected = images[b, :, row : row + 3, column : column + 3]
            assert torch.equal(found[b, v], expected)


def test_shifts_repeat_the_border():
    image = torch.tensor([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])[None, None]
    found = take_views(image, torch.tensor([[[0, 0], [1, 1], [2, 1]]]), size=3, padding=1)
    assert found[0, 0, 0].tolist() == [[1, 1, 2], [1, 1, 2], [4, 4, 5]]
    assert found[0, 1, 0].tolist() == image[0, 0].tolist()
    assert found[0, 2, 0].tolist() == [[4, 5, 6], [7, 8, 9], [7, 8, 9]]


def test_a_crop_has_the_same_offset_in_image_and_next_image():
    data = batch()
    out = from_replay(RandomViews(close_loop_images(SIZE), size=7, seed=0), data)
    found = set()
    for i in range(len(data)):
        assert out[keys.DEPTH].shape == (6, 1, 7, 7)
        offset = offset_of(out[keys.DEPTH][i], data[keys.DEPTH][i])
        assert offset == offset_of(out[keys.NEXT, keys.DEPTH][i], data[keys.NEXT, keys.DEPTH][i])
        found.add(offset)
    assert len(found) > 1
    assert data[keys.DEPTH].shape[-1] == SIZE  # the batch itself is unchanged


def test_every_offset_occurs_and_no_other():
    augment = RandomViews(close_loop_images(4), padding=1, seed=0)
    data = batch(count=400, size=4)
    out = augment(data)
    found = {
        offset_of(view, image, padding=1)
        for view, image in zip(out[keys.DEPTH], data[keys.DEPTH], strict=True)
    }
    assert found == {(row, column) for row in range(3) for column in range(3)}


def test_several_views_have_offsets_of_their_own():
    data = batch()
    out = from_replay(views(padding=2, views=3, target_views=2), data)
    assert out[keys.DEPTH].shape == (6, 3, 1, SIZE, SIZE)
    assert out[keys.NEXT, keys.DEPTH].shape == (6, 2, 1, SIZE, SIZE)
    different = 0
    for i in range(len(data)):
        offsets = {offset_of(v, data[keys.DEPTH][i], padding=2) for v in out[keys.DEPTH][i]}
        different += len(offsets)
        for view in out[keys.NEXT, keys.DEPTH][i]:
            offset_of(view, data[keys.NEXT, keys.DEPTH][i], padding=2)
    assert different > 12
    # several views of one of them only
    assert views(padding=2, target_views=2)(data)[keys.DEPTH].shape == (6, 1, SIZE, SIZE)


def test_the_holding_flag_and_the_action_are_unchanged_in_every_view():
    data = batch()
    out = views(padding=2, views=3, target_views=2, has_positive=True)(data)
    assert out[keys.HOLDING].shape == (6, 3, 1)
    assert out[keys.NEXT, keys.HOLDING].shape == (6, 2, 1)
    for i, holding in enumerate(data[keys.HOLDING]):
        assert out[keys.HOLDING][i].unique().tolist() == holding.tolist()
        assert out[keys.NEXT, keys.HOLDING][i].unique().tolist() == (~holding).tolist()
        assert out[keys.POSITIVE, keys.HOLDING][i].tolist() == holding.tolist()
    assert torch.equal(out[keys.ACTION], data[keys.ACTION])


def test_a_positive_is_another_view_of_the_same_image():
    data = batch()
    out = RandomViews(close_loop_images(SIZE), size=6, has_positive=True, seed=0)(data)
    pairs = [
        (offset_of(view, image), offset_of(positive, image))
        for view, positive, image in zip(
            out[keys.DEPTH], out[keys.POSITIVE, keys.DEPTH], data[keys.DEPTH], strict=True
        )
    ]
    assert any(first != second for first, second in pairs)


@pytest.mark.parametrize(("height", "start"), [(142, 7), (71, 3), (128, 0)])
def test_the_centre_crop_is_in_the_middle(height, start):
    images = torch.rand(2, 3, 1, height, height)
    size = 128 if height > 100 else 64
    expected = images[..., start : start + size, start : start + size]
    assert torch.equal(CenterCrop(size, ["depth"])(TensorDict(depth=images))["depth"], expected)


def test_images_smaller_than_the_centre_are_refused():
    with pytest.raises(ConfigError, match="no centre of 11 px"):
        CenterCrop(11, [keys.DEPTH])(batch())


def test_declarations_have_the_size_of_the_crop_and_small_images_are_refused():
    assert cropped_images(close_loop_images(142), 128)[keys.DEPTH].size == 128
    for size in (64, 128):  # all crops of 128 of 128 px would be the same
        with pytest.raises(ConfigError, match=rf"views.size=128: image 'depth' has only {size} px"):
            cropped_images(close_loop_images(size), 128)


def test_a_seed_determines_the_offsets_and_a_state_continues_them():
    first, second, data = views(padding=2), views(padding=2), batch()
    assert torch.equal(first(data)[keys.DEPTH], second(data)[keys.DEPTH])
    first(data)
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(data)[keys.DEPTH], second(data)[keys.DEPTH])
    assert not torch.equal(first(data)[keys.DEPTH], first(data)[keys.DEPTH])
    with pytest.raises(ValueError, match="views must be positive"):
        views(views=0)
    flat = batch()
    flat[keys.DEPTH] = flat[keys.DEPTH][:, 0]
    with pytest.raises(BatchError, match=r"'depth' is float32\[.*\], and must be square images"):
        views()(flat)
