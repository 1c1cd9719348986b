"""The rows of the table of measurements; the times are not tested."""

import pytest
import torch
from tqdm import tqdm

from ba_torchrl.core.errors import ConfigError
from profiling import throughput
from profiling.table import (
    GROUPS,
    MEASUREMENTS,
    Bench,
    measure,
)


def test_memory_is_counted():
    rows = measure("memory", repeats=2, progress=False)
    assert [row.unit for row in rows] == ["MB", "MB"]
    assert all(5 < row.values[0] <= row.budget.must for row in rows)


@pytest.mark.parametrize(
    ("collector", "workers"),
    [("single", 1), pytest.param("multi_sync", 2, marks=pytest.mark.slow)],
)
def test_the_frames_of_a_runs_collector_are_counted(collector, workers, monkeypatch):
    monkeypatch.setattr(throughput, "ROUND_S", 0.2)
    with tqdm(disable=True) as bar:
        (row,) = throughput.run_collection(Bench(2, bar), collector, workers)
    assert f"collector={collector}, {workers} worker" in row.work
    assert len(row.values) == len(row.unit_s) == 2
    assert min(row.values) > 0


def test_every_measurement_belongs_to_a_group():
    assert {name.split("/")[0] for name in MEASUREMENTS} == set(GROUPS)
    with pytest.raises(ConfigError, match="simulation, learning, throughput, memory, all"):
        measure("speed", repeats=1)


def test_a_profile_names_the_operations():
    profiles: dict[str, str] = {}
    matrix = torch.ones(64, 64)
    with tqdm(disable=True) as bar:
        bench = Bench(2, bar, profiles)
        times = bench.time_against({"unit": lambda: None}, {"product": lambda: matrix @ matrix})
    assert len(times["product"]) == 2
    assert set(profiles) == {"product"}
    assert "aten::mm" in profiles["product"]
    assert "[[64, 64], [64, 64]]" in profiles["product"]
