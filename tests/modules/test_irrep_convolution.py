"""Convolutions in the basis of irreps against those with the expanded filter."""

import os
import pickle

import pytest
import torch
import torch.nn.functional as F

from ba_torchrl.modules.steerable import cpu_threads, irrep_convolution as chunked
from ba_torchrl.modules.steerable.irrep_convolution import irrep_convolution, saves_time
from ba_torchrl.modules.steerable.kernels import kernel_block, regular_irrep_kernels
from ba_torchrl.modules.steerable.layers import SteerableConv2d, reuse_filters
from ba_torchrl.modules.steerable.planar import planar_rotations

GROUPS = {
    "C4": lambda: planar_rotations(4),
    "C8": lambda: planar_rotations(8),
    "C16": lambda: planar_rotations(16),
    "D4": lambda: planar_rotations(4, has_flips=True),
}


def expanded(group, coefficients):
    """The filter as the sum of the kernels."""
    block = kernel_block(group.regular_repr, group.regular_repr, 3)
    filters = torch.einsum("oid,dmyxn->ominyx", coefficients, block.kernels.to(coefficients))
    return filters.flatten(0, 1).flatten(1, 2)


def check(group, in_fields, out_fields, size, padding, batch=5):
    order = group.regular_repr.size
    kernels = regular_irrep_kernels(group.regular_repr)
    x = torch.randn(batch, in_fields * order, *size, requires_grad=True)
    terms = kernels.blocks[0].coupling.shape[0]
    coefficients = torch.randn(out_fields, in_fields, terms, requires_grad=True)
    bias = torch.randn(out_fields * order, requires_grad=True)
    inputs = (x, coefficients, bias)
    found = irrep_convolution(x, kernels, coefficients, bias, padding)

    exact = [tensor.detach().double().requires_grad_() for tensor in inputs]
    expected = F.conv2d(exact[0], expanded(group, exact[1]), exact[2], padding=padding)
    assert found.shape == expected.shape
    grad = torch.randn_like(found)
    pairs = [(found, expected)]
    pairs += zip(
        torch.autograd.grad(found, inputs, grad),
        torch.autograd.grad(expected, exact, grad.double()),
        strict=True,
    )
    for one, other in pairs:
        assert (one - other).abs().max() < 1e-5 * other.abs().max()


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("padding", [0, 1, 2])
def test_equals_the_convolution_with_the_expanded_filter(group, padding, threads):
    check(GROUPS[group](), 3, 2, (6, 9), padding)


def test_images_are_computed_in_groups(monkeypatch, threads):
    monkeypatch.setattr(chunked, "CHUNK_BYTES", 4 * 48 * 2 * 81 * 3)  # three images of 8 x 8
    check(planar_rotations(8), 2, 3, (8, 8), 1, batch=11)
    monkeypatch.setattr(chunked, "CHUNK_BYTES", 1)
    check(planar_rotations(8), 2, 3, (8, 8), 1)


@pytest.mark.parametrize(
    ("least_rows", "padding", "tops"),
    [
        (1, 0, list(range(11))),
        (3, 0, [0, 4, 8]),
        (3, 1, [0, 4, 8, 12]),
        (3, 2, [0, 3, 6, 9, 12]),
        (5, 1, [0, 7]),
        (7, 1, [0]),
        (20, 2, [0]),
    ],
)
def test_rows_of_large_images_are_computed_in_groups(monkeypatch, least_rows, padding, tops):
    monkeypatch.setattr(chunked, "CHUNK_BYTES", 1)
    monkeypatch.setattr(chunked, "LEAST_ROWS", least_rows)
    check(planar_rotations(4), 2, 3, (13, 9), padding)
    layout = chunked.Layout((2, 8, 13, 9), maps=12, order=4, padding=padding)
    assert [chunk.top for chunk in layout.chunks(slice(0, 2), 3)] == 2 * tops


def test_a_forked_process_starts_threads_of_its_own():
    cpu_threads._threads(2)
    child = os.fork()
    if not child:
        os._exit(cpu_threads._threads.cache_info().currsize)
    assert os.waitpid(child, 0)[1] == 0


def test_images_larger_than_a_strip():
    check(planar_rotations(4), 2, 2, (40, 40), 1, batch=2)


@pytest.mark.parametrize(
    ("group", "products", "dense"), [("C4", 36, 144), ("C8", 84, 576), ("D4", 72, 576)]
)
def test_products_per_pixel(group, products, dense):
    group = GROUPS[group]()
    order = group.regular_repr.size
    kernels = regular_irrep_kernels(group.regular_repr)
    assert sum(block.size * block.maps for block in kernels.blocks) == products
    assert 9 * order**2 == dense


def test_only_needed_gradients_are_computed():
    group = planar_rotations(4)
    kernels = regular_irrep_kernels(group.regular_repr)
    terms = kernels.blocks[0].coupling.shape[0]
    for needs_x, needs_weights in [(True, False), (False, True)]:
        x = torch.randn(2, 8, 6, 6, requires_grad=needs_x)
        coefficients = torch.randn(3, 2, terms, requires_grad=needs_weights)
        irrep_convolution(x, kernels, coefficients, None, 1).sum().backward()
        assert (x.grad is not None, coefficients.grad is not None) == (needs_x, needs_weights)


def test_large_layers_use_it_in_float32(threads):
    group = planar_rotations(8)
    fields = [(group.regular_repr, 32)]
    layer = SteerableConv2d(fields, fields, 3, padding=1)
    x = torch.randn(2, 256, 16, 16)
    assert layer._faster_kernels(x) is not None
    weight, bias = layer.expand()
    expected = F.conv2d(x, weight, bias, padding=1)
    assert (layer(x) - expected).abs().max() < 1e-5 * expected.abs().max()
    assert layer._faster_kernels(x.bfloat16()) is None
    with torch.no_grad(), reuse_filters():  # expanded once for all images
        assert layer._faster_kernels(x) is None
    copied = pickle.loads(pickle.dumps(layer))
    assert torch.equal(copied(x), layer(x))


def test_other_inputs_keep_the_expanded_filter():
    group = planar_rotations(4)
    fields = [(group.regular_repr, 64)]
    x = torch.randn(2, 256, 16, 16)
    layer = SteerableConv2d(fields, fields, 3, padding=1)
    assert layer(x[:0]).shape == (0, 256, 16, 16)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(x).dtype == torch.bfloat16
    assert layer.double()(x).dtype == torch.float32
    padded = SteerableConv2d(fields, fields, 3, padding=3)
    assert padded(x).shape == (2, 256, 20, 20)
    kernels = regular_irrep_kernels(group.regular_repr)
    with pytest.raises(ValueError, match="at most 2"):
        irrep_convolution(x, kernels, next(iter(layer.parameters())), None, 3)


def test_small_layers_and_other_fields_keep_the_expanded_filter():
    group = planar_rotations(8)
    kernels = regular_irrep_kernels(group.regular_repr)
    for threads in (1, 2):
        assert not saves_time(kernels, (32, 32), 4, 8, 1, threads)
        assert saves_time(kernels, (16, 16), 64, 128, 1, threads)
    assert saves_time(kernels, (32, 32), 8, 16, 1, 1)
    assert not saves_time(kernels, (32, 32), 8, 16, 1, 2)
    regular, trivial = group.regular_repr, group.trivial_repr
    for fields in ([(trivial, 64)], [(regular, 64), (trivial, 1)]):
        layer = SteerableConv2d(fields, [(regular, 64)], 3, padding=1)
        channels = sum(rep.size * count for rep, count in fields)
        assert layer._faster_kernels(torch.randn(1, channels, 16, 16)) is None
