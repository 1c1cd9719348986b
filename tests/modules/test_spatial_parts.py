"""Patches, dynamic filters and groups of yaws against independent arithmetic."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag

from ba_torchrl.modules.spatial.base import yaws_rad
from ba_torchrl.modules.spatial.in_hand import InHandMap, InHandVector
from ba_torchrl.modules.spatial.views import centre_fit, patches
from ba_torchrl.modules.steerable.layers import (
    DynamicSteerableConv2d,
    FilterGenerator,
    SteerableConv2d,
)
from ba_torchrl.modules.steerable.planar import planar_rotations, planar_yaws
from ba_torchrl.sim.vision.in_hand import crop


@pytest.mark.parametrize("size", [8, 7])
@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, 0.4, -2.0])
def test_patches_are_the_in_hand_images_of_the_environment(size, yaw):
    """Networks, in-hand image and gripper use the same convention of the yaw."""
    images = torch.rand(4, 1, 20, 20, generator=torch.Generator().manual_seed(0))
    pixels = torch.tensor([[10, 4], [0, 0], [19, 10], [7, 18]])
    actual = patches(images, pixels, size, torch.full((4,), yaw))
    for image, (row, column), patch in zip(images, pixels.tolist(), actual, strict=True):
        expected = crop(image[0].double().numpy(), (row + 0.5, column + 0.5), size, yaw)
        np.testing.assert_allclose(patch[0].numpy(), expected, atol=2e-5)
    if yaw == 0:
        assert torch.equal(patches(images, pixels, size), actual)


def test_yaws_span_half_a_turn_or_a_whole_one():
    device = torch.device("cpu")
    torch.testing.assert_close(yaws_rad(4, True, device), torch.arange(4) * math.pi / 4)
    torch.testing.assert_close(yaws_rad(4, False, device), torch.arange(4) * math.pi / 2)


@pytest.mark.parametrize("size", [20, 24, 30])
def test_centre_fit_keeps_the_centre(size):
    image = torch.rand(1, 1, 24, 24)
    fitted = centre_fit(image, size)
    assert fitted.shape[-2:] == (size, size)
    shared = min(size, 24)
    torch.testing.assert_close(centre_fit(fitted, shared), centre_fit(image, shared))
    assert fitted.sum() == pytest.approx(float(centre_fit(image, shared).sum()), rel=1e-5)


def test_in_hand_encoders_refuse_unsupported_sizes():
    assert InHandMap(1, 24, 0.1).out_size == 8
    assert InHandMap(1, 40, 0.1).out_size == 16
    for size, last in ((24, 6), (40, 5), (32, 4), (20, 5)):
        encoder = InHandVector(1, size, 0.25, 256)
        assert encoder.linear.in_features == 64 * last * last
        assert encoder(torch.rand(3, 1, size, size)).shape == (3, 256)
    with pytest.raises(ValueError, match="in_hand_size of at least 10"):
        InHandMap(1, 9, 0.1)
    with pytest.raises(ValueError, match="4 to 55"):
        InHandVector(1, 56, 0.1, 100)


# -- the dynamic filter -----------------------------------------------------------------------


def dynamic(kernel_size=3, count=3, group="D4"):
    found = planar_rotations(4, has_flips=True) if group == "D4" else planar_rotations(8)
    types = [(found.regular_repr, count)]
    layer = DynamicSteerableConv2d(*types[0], kernel_size)
    return types, layer, torch.randn(4, layer.num_coefficients)


@pytest.mark.parametrize(("group", "kernel_size"), [("D4", 3), ("C8", 3), ("C8", 1)])
def test_dynamic_filter_equals_a_loop_over_layers(group, kernel_size):
    torch.manual_seed(0)
    types, layer, coefficients = dynamic(kernel_size, group=group)
    x = torch.randn(4, layer.count * layer.size, 9, 9)
    twin = SteerableConv2d(types, types, kernel_size, padding=kernel_size // 2)
    (weights,) = twin.coefficients.values()
    assert layer.num_weights == weights.numel()
    actual = layer(x, coefficients)
    for sample_x, numbers, y in zip(x, coefficients, actual, strict=True):
        with torch.no_grad():
            weights.copy_(numbers[: layer.num_weights].view_as(weights))
            twin.bias.copy_(numbers[layer.num_weights :])
        expected = twin(sample_x[None])[0]
        torch.testing.assert_close(y, expected, atol=1e-4, rtol=1e-4)
    assert layer(x[:0], coefficients[:0]).shape == (0, *x.shape[1:])


def test_zero_features_give_a_he_initialised_filter():
    torch.manual_seed(0)
    types, layer, _ = dynamic(count=16)
    generator = FilterGenerator(64, layer)
    plain = SteerableConv2d(types, types, 3).coefficients["in0_out0"]
    coefficients = generator(torch.zeros(1, 64))[0]
    actual = coefficients[: layer.num_weights].reshape(-1, plain.shape[-1]).std(dim=0)
    torch.testing.assert_close(actual, plain.detach().flatten(0, 1).std(dim=0), rtol=0.3, atol=0)
    assert not coefficients[layer.num_weights :].any()
    moved = (
        generator(torch.randn(200, 64))[:, : layer.num_weights] - coefficients[: layer.num_weights]
    )
    spread = moved.reshape(-1, plain.shape[-1]).std(dim=0).detach()
    torch.testing.assert_close(spread, actual.detach(), rtol=0.3, atol=0)


# -- groups -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("half", "order", "size"), [(True, 8, 4), (False, 4, 4)])
def test_values_of_yaws_shift_by_one_per_step(half, order, size):
    representation = planar_yaws(4, half)
    group, change = representation.group, representation.change_of_basis
    assert (group.order, representation.size) == (order, size)
    step = block_diag(*(group.matrix(irrep, (0, 1)) for irrep in representation.irreps))
    step = change @ step @ change.T
    np.testing.assert_allclose(step, np.roll(np.eye(size), 1, axis=0), atol=1e-12)
