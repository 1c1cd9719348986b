"""Fingerprints of environments: equal for equal code, different for any change."""

import dataclasses
import json

import pytest

from profiling.fingerprint.cases import Case
from profiling.fingerprint.compare import compare, differences
from profiling.fingerprint.record import run_case


@pytest.fixture(scope="module")
def case():
    return Case(
        name="small",
        part="envs",
        task="close_loop/block_reaching",
        kind="env",
        config={"obs_size": 16},
        plan={"expert": 1, "random": 3},
    )


def test_two_runs_are_equal(case):
    first = json.loads(json.dumps(run_case(case)))
    assert first["traces"]["expert 0"]["facts"]["success"]
    assert differences(first, run_case(case)) == []


def test_another_seed_is_a_difference_with_its_place_and_size(case):
    old = run_case(case)
    new = run_case(dataclasses.replace(case, seed=case.seed + 1))
    lines = compare({"small": old}, {"small": new})["small"]
    assert any(line.startswith("expert 0: step 0: depth: sum differs by ") for line in lines)
    assert any(line.startswith("random: step 1: action: difference ") for line in lines)


def test_a_changed_number_is_found(case):
    old = run_case(case)
    new = json.loads(json.dumps(old))
    new["traces"]["random"]["steps"][2]["reward"] = ["0" * 16, [0.5]]
    (line,) = differences(old, new)
    assert line == "random: step 2: reward: difference 0.5, [0] -> [0.5]"
