"""Registration of every task with Gymnasium, in any order of imports."""

import json
import subprocess
import sys
import warnings

import gymnasium
import pytest

import ba_torchrl
from ba_torchrl.envs.registration import gym_id, register_tasks
from ba_torchrl.tasks.base import TASKS, Task

BUILT_IN = [task for task in TASKS if TASKS.plugin_module(task) is None]
PICKING = "BulletArm/CloseLoopBlockPicking-v0"


@pytest.mark.parametrize(
    ("task", "wanted"),
    [
        ("close_loop/block_picking", "BulletArm/CloseLoopBlockPicking-v0"),
        ("open_loop/house_building_3", "BulletArm/OpenLoopHouseBuilding3-v0"),
        ("ramp/block_stacking", "BulletArm/RampBlockStacking-v0"),
    ],
)
def test_gym_ids_are_camel_case(task, wanted):
    assert gym_id(task) == wanted


def test_an_id_ends_in_the_version_of_the_task(monkeypatch):
    monkeypatch.setattr(TASKS["close_loop/block_picking"], "version", 2)
    assert gym_id("close_loop/block_picking") == PICKING.replace("-v0", "-v2")


def ids(task):
    """The ids of a task: images, states, and states with dense rewards and goals if it has them."""
    kinds = ["", "State"]
    kinds += ["StateDense"] if TASKS[task].progress is not Task.progress else []
    kinds += ["Goal"] if TASKS[task].goal_vectors is not None else []
    return [gym_id(task, kind) for kind in kinds]


def test_every_task_has_ids_of_its_own():
    specs = {spec.id: spec for spec in gymnasium.registry.values() if spec.namespace == "BulletArm"}
    expected = {name: task for task in ba_torchrl.list_tasks() for name in ids(task)}
    assert {name: spec.kwargs["task"] for name, spec in specs.items()} == expected
    assert "BulletArm/CloseLoopBlockReaching-StateDense-v0" in specs
    assert "BulletArm/OpenLoopCovidTest-State-v0" in specs
    assert "BulletArm/CloseLoopBlockPushing-Goal-v0" in specs
    assert "BulletArm/OpenLoopCovidTest-StateDense-v0" not in specs
    assert all(spec.max_episode_steps is None for spec in specs.values())


def test_registering_again_adds_only_what_is_missing(monkeypatch):
    before = gymnasium.registry[PICKING]
    missing = gym_id("close_loop/block_reaching")
    monkeypatch.delitem(gymnasium.registry, missing)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_tasks()
    assert missing in gymnasium.registry
    assert gymnasium.registry[PICKING] is before


def run(code, folder):
    """Run ``code`` in a fresh interpreter, outside the repository; return what it prints last."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "imports",
    [
        "import ba_torchrl, gymnasium",
        "import gymnasium, ba_torchrl",
        "import ba_torchrl, importlib.util; importlib.util.find_spec('gymnasium')",
    ],
)
def test_ids_are_registered_in_any_import_order_and_without_torch(imports, tmp_path):
    known, loaded = run(
        f"{imports}\nimport gymnasium, json, sys\n"
        "known = sorted(name for name in gymnasium.registry if name.startswith('BulletArm/'))\n"
        "print(json.dumps([known, sorted(sys.modules)]))",
        tmp_path,
    )
    assert known == sorted(name for task in BUILT_IN for name in ids(task))
    assert not {"torch", "torchrl"} & set(loaded)


def test_make_needs_no_import_of_the_package(tmp_path):
    code = (
        "import gymnasium, json, sys\n"
        "light = not {'torch', 'pybullet', 'ba_torchrl'} & set(sys.modules)\n"
        f"env = gymnasium.make('ba_torchrl:{PICKING}', obs_size=16)\n"
        "observation, info = env.reset(seed=0)\n"
        "env.close()\n"
        "print(json.dumps([light, observation['depth'].shape]))"
    )
    assert run(code, tmp_path) == [True, [1, 16, 16]]
