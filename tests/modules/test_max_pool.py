"""ReLU of max pooling against PyTorch's functions."""

from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from threading import Barrier

import pytest
import torch
import torch.nn.functional as F
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils.flop_counter import FlopCounterMode

from ba_torchrl.modules.steerable import cpu_threads
from ba_torchrl.modules.steerable.cpu_threads import in_parts
from ba_torchrl.modules.steerable.max_pool import relu_of_max_pool
from tests.fresh import run_script

LAYOUTS = {"contiguous": torch.contiguous_format, "channels-last": torch.channels_last}


def check(x, grad=None):
    """Check values, layout and gradient; they must be equal."""
    for slope in (0.0, 0.1):
        ours, theirs = x.detach().clone().requires_grad_(), x.detach().clone().requires_grad_()
        found = relu_of_max_pool(ours, slope)
        expected = F.max_pool2d(theirs, 2)
        expected = F.leaky_relu(expected, slope) if slope else F.relu(expected)
        assert torch.equal(found, expected)
        for layout in LAYOUTS.values():
            same = found.is_contiguous(memory_format=layout)
            assert same == expected.is_contiguous(memory_format=layout)
        slopes = torch.randn_like(expected) if grad is None else grad
        found.backward(slopes)
        expected.backward(slopes)
        assert torch.equal(ours.grad, theirs.grad)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [(2, 2), (8, 8), (7, 10), (10, 7), (33, 70)], ids=str)
def test_equals_pytorch(layout, size, threads):
    x = torch.randn(3, 5, *size).to(memory_format=LAYOUTS[layout])
    assert x.is_contiguous(memory_format=LAYOUTS[layout])
    check(x)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_equal_values_give_the_gradient_to_the_first(layout):
    x = torch.randint(-1, 3, (4, 3, 12, 12)).float().to(memory_format=LAYOUTS[layout])
    check(x)


@pytest.mark.parametrize("place", range(4))
def test_nan_is_not_lost(place):
    x = torch.randn(1, 2, 2, 2)
    x.view(2, 4)[0, place] = torch.nan
    y = relu_of_max_pool(x).flatten()
    assert y[0].isnan()
    assert not y[1].isnan()


def test_views_and_expanded_gradients():
    x = torch.randn(2, 6, 9, 12)
    for view in (x[:, ::2], x[..., 1:], x.transpose(2, 3)):
        view = view.detach()
        ours, theirs = view.requires_grad_(), view.detach().clone().requires_grad_()
        found, expected = relu_of_max_pool(ours), F.relu(F.max_pool2d(theirs, 2))
        assert torch.equal(found, expected)
        found.sum().backward()
        expected.sum().backward()
        assert torch.equal(ours.grad, theirs.grad)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_other_formats(dtype):
    check(torch.randn(2, 3, 8, 8, dtype=dtype))


def test_no_images():
    assert relu_of_max_pool(torch.zeros(0, 3, 8, 8)).shape == (0, 3, 4, 4)


def test_positions_take_one_byte_and_are_freed():
    packed = []
    x = torch.randn(2, 3, 8, 8, requires_grad=True)
    with torch.autograd.graph.saved_tensors_hooks(lambda t: packed.append(t) or t, lambda t: t):
        total = relu_of_max_pool(x).sum()
    assert [tensor.nbytes for tensor in packed] == [2 * 3 * 4 * 4]
    total.backward()
    with pytest.raises(RuntimeError, match="second time"):
        total.backward()


def test_second_derivatives_are_refused():
    x, w = torch.randn(2, 3, 8, 8, requires_grad=True), torch.tensor(3.0, requires_grad=True)
    for y in (relu_of_max_pool(x), relu_of_max_pool(w * x).square()):
        with pytest.raises(RuntimeError, match="no second derivative"):
            torch.autograd.grad(y.sum(), x, create_graph=True)


def test_it_works_below_function_transforms():
    x = torch.randn(4, 2, 3, 8, 8)
    expected = F.relu(F.max_pool2d(x.flatten(0, 1), 2)).unflatten(0, (4, 2))
    assert torch.equal(torch.func.vmap(relu_of_max_pool)(x), expected)
    gradient = torch.func.grad(lambda x: relu_of_max_pool(x).square().sum())(x[0])
    hand = torch.func.grad(lambda x: F.relu(F.max_pool2d(x, 2)).square().sum())(x[0])
    assert torch.equal(gradient, hand)
    _, tangent = torch.func.jvp(relu_of_max_pool, (x[0],), (torch.ones_like(x[0]),))
    assert torch.equal(tangent, (expected[0] > 0).float())
    graph = make_fx(lambda x: relu_of_max_pool(x))(x[0])
    assert torch.equal(graph(x[1]), expected[1])


def test_parts_cover_the_batch_once(threads):
    parts = in_parts(7, lambda part: list(range(7))[part])
    assert len(parts) == threads
    assert list(chain(*parts)) == list(range(7))


def test_counts_of_operations_contain_all_parts(threads):
    a, b = torch.randn(6, 4, 5), torch.randn(5, 3)
    with FlopCounterMode(display=False) as counter:
        in_parts(6, lambda part: a[part].flatten(0, 1) @ b)
    assert counter.get_total_flops() == 2 * 6 * 4 * 5 * 3


END = """
import threading, time, torch
from ba_torchrl.modules.steerable.cpu_threads import in_parts
torch.set_num_threads(2)
assert in_parts(4, lambda part: part.stop) == [2, 4]

def later():
    time.sleep(0.5)
    print(in_parts(4, lambda part: part.stop))

threading.Thread(target=later).start()
"""


def test_threads_that_outlive_the_main_thread_work_on(tmp_path):
    done = run_script(tmp_path, END)
    assert done.stdout == "[2, 4]\n", done.stderr


@pytest.mark.usefixtures("two_threads")
def test_the_first_use_by_several_threads_keeps_their_number_of_threads():
    for _ in range(20):
        cpu_threads._threads.cache_clear()
        barrier = Barrier(3, timeout=60.0)

        def use(_, barrier=barrier):
            barrier.wait()
            in_parts(4, lambda part: part)
            return torch.get_num_threads()

        with ThreadPoolExecutor(3) as pool:
            assert list(pool.map(use, range(3))) == [2, 2, 2]


@pytest.mark.usefixtures("two_threads")
def test_work_in_threads_does_not_start_threads():
    assert in_parts(4, lambda _: torch.get_num_threads()) == [1, 1]
    assert torch.get_num_threads() == 2
    cpu_threads._threads.cache_clear()
