"""The record of what environments compute: equal for equal code, different for any change."""

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[1] / "recipes" / "fingerprint.py"


@pytest.fixture(scope="module")
def fingerprint():
    spec = importlib.util.spec_from_file_location("fingerprint", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def case(fingerprint):
    return fingerprint.Case(
        name="small",
        part="envs",
        task="close_loop/block_reaching",
        kind="env",
        config={"obs_size": 16},
        plan={"expert": 1, "random": 3},
    )


def test_two_runs_are_equal(fingerprint, case):
    first = json.loads(json.dumps(fingerprint.run_case(case)))
    assert first["traces"]["expert 0"]["facts"]["success"]
    assert fingerprint.differences(first, fingerprint.run_case(case)) == []


def test_another_seed_is_a_difference_with_its_place_and_size(fingerprint, case):
    old = fingerprint.run_case(case)
    new = fingerprint.run_case(dataclasses.replace(case, seed=case.seed + 1))
    lines = fingerprint.compare({"small": old}, {"small": new})["small"]
    assert any(line.startswith("expert 0: step 0: pixels: sum differs by ") for line in lines)
    assert any(line.startswith("random: step 1: action: difference ") for line in lines)


def test_a_changed_number_is_found(fingerprint, case):
    old = fingerprint.run_case(case)
    new = json.loads(json.dumps(old))
    new["traces"]["random"]["steps"][2]["reward"] = ["0" * 16, [0.5]]
    (line,) = fingerprint.differences(old, new)
    assert line == "random: step 2: reward: difference 0.5, [0] -> [0.5]"


def test_what_the_configuration_refuses_is_recorded(fingerprint, case):
    refused = dataclasses.replace(case, config={"deconstruct": True})
    record = fingerprint.run_case(refused)
    assert record["facts"]["refused"].startswith("'deconstruct' has no meaning")


def test_every_task_has_cases_and_names_are_unique(fingerprint):
    names = [case.name for case in fingerprint.cases(fingerprint.PARTS)]
    assert len(set(names)) == len(names)
    (task,) = {case.task for case in fingerprint.cases(["envs"], ["open_loop/covid_test"])}
    assert task == "open_loop/covid_test"
