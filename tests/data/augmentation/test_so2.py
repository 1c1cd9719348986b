"""Rotation of transitions."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError, ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.augmentation.so2 import (
    SO2Augmentation,
    StoredCopies,
    rotate_displacement,
    rotate_images,
)
from tests.specs import from_replay

IMAGES = {"depth": ImageSpec(1, 32, 0.4)}


def angles(*values):
    return torch.tensor(values, dtype=torch.float64)


def batch(n=32, size=32, actions=5):
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    return TensorDict(
        {
            keys.DEPTH: rand(n, 1, size, size),
            keys.ACTION: rand(n, actions) * 2 - 1,
            keys.HOLDING: rand(n, 1) > 0.5,
            keys.NEXT: {keys.DEPTH: rand(n, 1, size, size), keys.REWARD: rand(n, 1)},
        },
        [n],
    )


def blob(x, y, size=64):
    """A bump at world coordinates in [-0.5, 0.5], rows along x and columns along y."""
    centres = (torch.arange(size) + 0.5) / size - 0.5
    gx, gy = torch.meshgrid(centres, centres, indexing="ij")
    return torch.exp(-((gx - x) ** 2 + (gy - y) ** 2) / (2 * 0.04**2))


def centroid(image):
    size = image.shape[-1]
    centres = (torch.arange(size) + 0.5) / size - 0.5
    total = image.sum()
    return float((image.sum(1) * centres).sum() / total), float(
        (image.sum(0) * centres).sum() / total
    )


@pytest.mark.parametrize("size", [31, 64])
@pytest.mark.parametrize("k", [-1, 0, 1, 2, 3, 4])
def test_quarter_turns_are_bit_exact(k, size):
    images = torch.rand(2, 3, size, size)
    turned = rotate_images(images, angles(k * math.pi / 2, k * math.pi / 2))
    assert torch.equal(turned, torch.rot90(images, k, (-2, -1)))
    vector = torch.tensor([[0.3, -0.8]])
    expected = vector.clone()
    for _ in range(k % 4):
        expected = torch.stack([-expected[:, 1], expected[:, 0]], dim=-1)
    assert torch.equal(rotate_displacement(vector, angles(k * math.pi / 2)), expected)


@pytest.mark.parametrize("angle", [0.3, math.pi / 4, 2.0, 4.0, 6.1])
def test_a_position_and_the_vector_to_it_rotate_together(angle):
    x, y = 0.21, -0.13
    turned = rotate_images(blob(x, y)[None, None], angles(angle))
    vector = rotate_displacement(torch.tensor([[x, y]]), angles(angle))[0]
    assert centroid(turned[0, 0]) == pytest.approx(vector.tolist(), abs=0.005)
    expected = (
        math.cos(angle) * x - math.sin(angle) * y,
        math.sin(angle) * x + math.cos(angle) * y,
    )
    assert vector.tolist() == pytest.approx(expected, abs=1e-6)


def test_rotation_is_continuous_at_quarter_turns():
    image = blob(0.2, 0.1)[None, None]
    for k in range(4):
        exact = rotate_images(image, angles(k * math.pi / 2))
        near = rotate_images(image, angles(k * math.pi / 2 + 1e-4))
        torch.testing.assert_close(near, exact, atol=1e-2, rtol=0)


def test_pixels_outside_the_image_repeat_the_border():
    image = torch.full((1, 1, 32, 32), 0.25)
    assert torch.allclose(rotate_images(image, angles(0.7)), image, atol=1e-6)


def test_a_vector_that_leaves_the_box_keeps_its_direction():
    corner = torch.tensor([[1.0, 1.0], [0.9, -0.9], [0.3, 0.2]])
    angle = angles(math.pi / 4, 0.5, math.pi / 4)
    turned = rotate_displacement(corner, angle)
    assert turned.abs().max() <= 1
    torch.testing.assert_close(turned[0], torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0)
    for before, after, a in zip(corner, turned, angle.tolist(), strict=True):
        wanted = math.atan2(before[1], before[0]) + a
        actual = math.atan2(after[1], after[0])
        assert math.cos(wanted - actual) == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(turned[2].norm(), corner[2].norm())  # inside: not shortened


def test_transitions_without_an_action_are_refused():
    with pytest.raises(KeyError, match="action"):
        SO2Augmentation(IMAGES, "pxyzr", seed=3, probability=1.0)(batch().exclude(keys.ACTION))


@pytest.mark.parametrize("sequence", ["pxyzr", "pxyz", "yzpx"])
def test_one_angle_per_transition_for_all_three_entries(sequence):
    data = batch(actions=len(sequence))
    x, y = sequence.index("x"), sequence.index("y")
    data[keys.ACTION] *= 0.5  # short enough never to leave the box
    data[keys.TARGET_ACTION] = -data[keys.ACTION]
    data[keys.TARGET_CHUNK] = torch.stack([data[keys.ACTION], -data[keys.ACTION] / 2], dim=1)
    before = data.clone()
    # Images that show their action: a spot at 0.6 (dx, dy), another at its opposite.
    for i in range(len(data)):
        dx, dy = 0.6 * data[keys.ACTION][i, [x, y]]
        data[keys.DEPTH][i, 0] = blob(dx, dy, 32)
        data[keys.NEXT, keys.DEPTH][i, 0] = blob(-dx, -dy, 32)
    shown = data.clone()
    out = from_replay(SO2Augmentation(IMAGES, sequence, seed=3, probability=1.0), data)
    assert (data == shown).all()  # the input is not changed
    moved = (out[keys.ACTION] - before[keys.ACTION]).abs()
    others = [i for i in range(len(sequence)) if i not in (x, y)]
    assert not moved[:, others].any()
    torch.testing.assert_close(out[keys.TARGET_ACTION], -out[keys.ACTION])
    chunk = torch.stack([out[keys.ACTION], -out[keys.ACTION] / 2], dim=1)
    torch.testing.assert_close(out[keys.TARGET_CHUNK][:, :, [x, y]], chunk[:, :, [x, y]])
    assert torch.equal(out[keys.TARGET_CHUNK][:, :, others], data[keys.TARGET_CHUNK][:, :, others])
    assert (moved[:, [x, y]].sum(-1) > 1e-3).float().mean() > 0.9
    for i in range(len(data)):
        wanted = (0.6 * out[keys.ACTION][i, [x, y]]).tolist()
        assert centroid(out[keys.DEPTH][i, 0]) == pytest.approx(wanted, abs=0.02)
        opposite = [-v for v in wanted]
        assert centroid(out[keys.NEXT, keys.DEPTH][i, 0]) == pytest.approx(opposite, abs=0.02)
    assert torch.equal(out[keys.HOLDING], data[keys.HOLDING])
    assert torch.equal(out[keys.NEXT, keys.REWARD], data[keys.NEXT, keys.REWARD])


def test_probability():
    data = batch(n=1000, size=4)
    for probability in (0.0, 0.8, 1.0):
        out = SO2Augmentation(IMAGES, "pxyzr", seed=0, probability=probability)(data)
        same = (out[keys.ACTION] == data[keys.ACTION]).all(-1)
        same_image = (out[keys.DEPTH] == data[keys.DEPTH]).flatten(1).all(-1)
        assert torch.equal(same, same_image)
        assert 1 - same.float().mean().item() == pytest.approx(probability, abs=0.04)


def test_angles_are_uniform():
    data = batch(n=4000, size=4)
    data[keys.ACTION] = torch.tensor([0.0, 0.5, 0.0, 0.0, 0.0]).expand(4000, 5).clone()
    out = SO2Augmentation(IMAGES, "pxyzr", seed=0, probability=1.0)(data)
    angle = torch.atan2(out[keys.ACTION][:, 2], out[keys.ACTION][:, 1])
    counts = torch.histc(angle, bins=8, min=-math.pi, max=math.pi)
    chi_square = ((counts - 500) ** 2 / 500).sum()
    assert chi_square < 24.3  # 0.999 quantile for 7 degrees of freedom


def test_draws_come_from_the_modules_own_generator():
    data = batch()
    one, two = SO2Augmentation(IMAGES, "pxyzr", seed=5), SO2Augmentation(IMAGES, "pxyzr", seed=5)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first = one(data)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(1)
    assert (two(data) == first).all()
    second = one(data)
    assert not torch.equal(second[keys.DEPTH], first[keys.DEPTH])  # another view
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    assert (two(data) == one(data)).all()
    other = SO2Augmentation(IMAGES, "pxyzr", seed=6)(data)
    assert not torch.equal(other[keys.DEPTH], first[keys.DEPTH])


def test_episodes_of_several_dimensions_are_refused_with_the_way_out():
    with pytest.raises(ConfigError, match=r"SO2Augmentation takes .* \[B\], .*reshape\(-1\)"):
        SO2Augmentation(IMAGES, "pxyzr", seed=0)(batch(n=4).reshape(2, 2))
    rows = batch()
    rows[keys.DEPTH] = rows[keys.DEPTH].movedim(1, -1)
    with pytest.raises(BatchError, match=r"'depth' is float32\[.*, 1\], and must be square images"):
        SO2Augmentation(IMAGES, "pxyzr", seed=0, probability=1.0)(rows)
    codes = batch()
    codes[keys.DEPTH] = codes[keys.DEPTH].byte()
    with pytest.raises(ConfigError, match=r"depth holds codes, torch.uint8: .* after ImageCodecs"):
        SO2Augmentation(IMAGES, "pxyzr", seed=0)(codes)


def test_invalid_arguments_are_refused():
    with pytest.raises(ValueError, match="probability"):
        SO2Augmentation(IMAGES, "pxyz", seed=0, probability=1.5)
    with pytest.raises(ValueError, match="no x and y"):
        SO2Augmentation(IMAGES, "pz", seed=0)
    with pytest.raises(ValueError, match="use RigidAugmentation"):
        SO2Augmentation({"heightmap": ImageSpec(1, 32, 0.4)}, "pxyr", seed=0)


def test_each_transition_is_followed_by_its_rotated_copies():
    rotation = SO2Augmentation(IMAGES, "pxyzr", seed=0, probability=1.0)
    data = batch(n=3)
    data["number"] = torch.arange(3)
    data[keys.ACTION] *= 0.5  # short enough never to leave the box
    replay = ReplayBuffer(storage=LazyTensorStorage(20), transform=StoredCopies(rotation, 4))
    replay.extend(data)
    out = replay[:]
    assert out["number"].tolist() == [0] * 5 + [1] * 5 + [2] * 5
    assert len(out[keys.ACTION].unique(dim=0)) == 15  # each copy has an angle of its own
    for i in range(15):
        original, copy = data[i // 5], out[i]
        assert torch.equal(copy[keys.NEXT, keys.REWARD], original[keys.NEXT, keys.REWARD])
        if i % 5 == 0:
            assert (copy == original).all()
            continue
        old, new = original[keys.ACTION], copy[keys.ACTION]
        assert torch.equal(old[[0, 3, 4]], new[[0, 3, 4]])
        angle = (torch.atan2(new[2], new[1]) - torch.atan2(old[2], old[1]))[None].double()
        turned = rotate_images(original[keys.DEPTH][None], angle)[0]
        torch.testing.assert_close(copy[keys.DEPTH], turned, atol=2e-4, rtol=0)
