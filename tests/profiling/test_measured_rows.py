"""Values that measurements add to the table: share of the limit and frames per second."""

import statistics

import pytest
import torch
import torch.nn.functional as F
from tqdm import tqdm

from ba_torchrl.core.config import WorkerOptions
from profiling import learning, limits, throughput
from profiling.limits import count_multiply_adds
from profiling.table import COLUMNS, Bench, Budget, Row, as_markdown


def test_multiply_adds_of_forward_and_backward():
    left, right = torch.randn(3, 4), torch.randn(4, 5, requires_grad=True)
    assert count_multiply_adds(lambda: left @ right) == 3 * 4 * 5
    assert count_multiply_adds(lambda: (left @ right).sum().backward()) == 2 * 3 * 4 * 5


@pytest.mark.parametrize("groups", [1, 2, 4])
def test_multiply_adds_of_a_grouped_convolution(groups):
    images = torch.randn(2, 8, 9, 9, requires_grad=True)
    filters = torch.randn(12, 8 // groups, 3, 3, requires_grad=True)
    forward = 2 * 12 * 9 * 9 * (8 // groups) * 3 * 3

    def call():
        F.conv2d(images, filters, padding=1, groups=groups).sum().backward()

    assert count_multiply_adds(call) == 3 * forward


def test_share_of_the_limit():
    row = Row("update", "ms", [40.0, 50.0, 90.0], limit_s=[0.01, 0.02, 0.1])
    assert row.share_of_limit == pytest.approx(0.4)
    assert as_markdown([row], COLUMNS).splitlines()[-1].split("|")[6] == " 40% "
    assert Row("step", "ms", [1.0]).share_of_limit is None


@pytest.mark.parametrize(
    ("has_amx", "precision", "reference"),
    [(False, "bfloat16", "2"), (True, "float32", "2"), (True, "bfloat16", "1")],
)
def test_an_update_has_a_limit_and_the_budget_of_its_instructions(
    monkeypatch, has_amx, precision, reference
):
    monkeypatch.setitem(limits.SIZE, "cpu", 64)
    monkeypatch.setattr(learning, "amx_is_used", lambda: has_amx)
    monkeypatch.setattr(learning, "LearningUnit", lambda _: lambda: None)
    experiment = {
        "task": "close_loop/block_reaching",
        "algorithm": {"name": "sac", "batch_size": 2},
    }
    with tqdm(disable=True) as bar:
        (row,) = learning.measure_update(
            Bench(2, bar, precision=precision),
            learning.Update(
                "update",
                experiment,
                {"name": "cnn", "width": 0.125},
                64,
                with_amx=Budget("1", None, None),
                without_amx=Budget("2", None, None),
            ),
        )
    assert row.budget.reference == reference
    assert len(row.values) == len(row.unit_s) == len(row.limit_s) == 2
    medians = [statistics.median(seconds) for seconds in (row.limit_s, row.values)]
    assert row.share_of_limit == pytest.approx(medians[0] / medians[1])
    assert f"multiply-adds, {precision} matrix product" in row.notes


def test_frames_per_second(monkeypatch):
    # Forking is fast; it needs a process without an open simulator, so workers come first.
    vectors = {
        "workers, shared memory": {"workers": WorkerOptions(start_method="fork")},
        "one process": {"workers": WorkerOptions(parallel=False)},
    }
    monkeypatch.setattr(throughput, "VECTORS", vectors)
    monkeypatch.setattr(throughput, "STEPS", 3)
    with tqdm(disable=True) as bar:
        rows = throughput.collection(Bench(2, bar), "close_loop/block_reaching", 2)
    assert [row.work for row in rows] == [
        f"close_loop/block_reaching, collection, 2 environments, {name}" for name in vectors
    ]
    for row in rows:
        assert row.unit == "frames/s"
        assert len(row.values) == 2
        assert all(0 < value < 20_000 for value in row.values)
        assert row.multiple == pytest.approx(
            sum(row.values) / 2 * sum(row.unit_s) / 2
        )  # frames during a unit
