"""Eight-bit depth and half-precision heights."""

import pytest
import torch

from ba_torchrl.data.replay.codecs import DepthQuantizer, HalfPrecision


@pytest.mark.parametrize("high_m", [0.32, 0.45, 1.0])
def test_error_is_at_most_half_a_step(high_m):
    quantizer = DepthQuantizer(high_m)
    depth = torch.linspace(0, high_m, 100_001)
    error = (quantizer(depth) - depth).abs().max().item()
    assert quantizer.max_error_m == pytest.approx(high_m / 510)
    assert error <= quantizer.max_error_m * (1 + 1e-4)
    assert error > 0.99 * quantizer.max_error_m  # the stated bound is reached


def test_every_code_survives_a_round_trip():
    quantizer = DepthQuantizer(0.32)
    codes = torch.arange(256, dtype=torch.uint8)
    assert torch.equal(quantizer.encode(quantizer.decode(codes)), codes)


def test_ends_and_clipping():
    quantizer = DepthQuantizer(0.32)
    depth = torch.tensor([-1.0, 0.0, 0.32, 5.0])
    assert quantizer.encode(depth).tolist() == [0, 0, 255, 255]
    assert quantizer(depth).tolist() == pytest.approx([0, 0, 0.32, 0.32])
    assert quantizer(depth)[1] == 0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3, 1, 4, 4)])
def test_any_shape_and_floating_type(shape, dtype):
    quantizer = DepthQuantizer(0.32)
    depth = (torch.rand(shape) * 0.32).to(dtype)
    original = depth.clone()
    codes, restored = quantizer.encode(depth), quantizer(depth)
    assert codes.dtype == torch.uint8
    assert codes.shape == restored.shape == shape
    assert torch.equal(restored, quantizer.decode(codes).to(dtype))
    assert restored.dtype == dtype
    assert quantizer.decode(codes).dtype == torch.float32
    assert torch.equal(depth, original)


def test_invalid_arguments_are_refused():
    with pytest.raises(ValueError, match="positive"):
        DepthQuantizer(0)
    with pytest.raises(TypeError, match="floating"):
        DepthQuantizer(1.0).encode(torch.zeros(3, dtype=torch.uint8))


@pytest.mark.parametrize("high_m", [0.1, 0.24, 0.25, 0.3])
def test_the_error_of_half_precision_is_half_its_spacing(high_m):
    codec = HalfPrecision(high_m)
    heights = torch.linspace(0, high_m, 400_001)[:-1]
    error = (codec(heights) - heights).abs().max().item()
    assert error <= codec.max_error_m
    assert error > 0.9 * codec.max_error_m  # the stated bound is reached
    assert codec.max_error_m < high_m / 1000


def test_half_precision_stores_two_bytes_and_what_the_policy_sees():
    codec = HalfPrecision(0.25)
    image = torch.rand(3, 1, 8, 6) * 0.25
    codes = codec.encode(image)
    assert codes.dtype == torch.uint8
    assert codes.shape == (3, 1, 8, 12)
    assert torch.equal(codec.decode(codes), codec(image))
    assert codec(image).dtype == torch.float32
    with pytest.raises(TypeError, match="floating"):
        codec.encode(torch.zeros(2, dtype=torch.uint8))
    with pytest.raises(ValueError, match="positive"):
        HalfPrecision(0.0)
