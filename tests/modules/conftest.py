from concurrent.futures import ThreadPoolExecutor

import pytest
import torch


def threads_of_a_new_thread():
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


@pytest.fixture(params=[1, 2], ids=["one-thread", "two-threads"])
def threads(request):
    """A number of threads, which what is tested does not change."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    found = torch.get_num_threads(), threads_of_a_new_thread()
    torch.set_num_threads(before)
    assert found == (request.param, request.param)


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)
