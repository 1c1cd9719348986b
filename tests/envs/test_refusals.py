"""Refused parameters of an environment, with messages that state the allowed values."""

import math

import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import TASKS

PICKING = "close_loop/block_picking"


def test_render_needs_a_display(make, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="DISPLAY"):
        make(PICKING, render=True)


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        (PICKING, {"in_hand_size": 40}, "open-loop"),
        (PICKING, {"object_set": "household"}, "no meaning"),
        (PICKING, {"asset_root": "somewhere"}, "no meaning"),
        ("close_loop/block_stacking", {"object_type": "cylinder"}, "no meaning"),
        ("open_loop/block_stacking", {"object_type": "ball"}, "'cube' or 'cylinder'"),
        (PICKING, {"num_objects": 2}, "has 1, not 2"),
        ("close_loop/house_building", {"num_objects": 5}, "2 to 4"),
        (PICKING, {"solver_iterations": 10}, "physics_mode='custom'"),
        (PICKING, {"physics_mode": "custom"}, "time_step_s"),
        (PICKING, {"floor_color": (0.1, 0.2)}, "red, green and blue"),
        (PICKING, {"workspace_color": (0.1, 0.2, 2.0)}, "red, green and blue"),
        (PICKING, {"view_type": "from_below"}, "camera_center_xyz"),
        (PICKING, {"": 1}, "unknown parameter ''"),
        (PICKING, {"drot": math.inf}, "finite"),
        (PICKING, {"dpos": math.nan}, "dpos"),
        (PICKING, {"view_scale": math.inf}, "finite"),
        (PICKING, {"action_sequence": ""}, "pxyzr"),
        (PICKING, {"reward": "dense", "reward_discount": 0.9}, "reward_discount has no effect"),
        ("open_loop/bin_packing", {"reward": "dense"}, r"no dense reward; it is for .*house_b"),
        ("close_loop/block_pulling", {"close_loop_tray": True}, "block_picking"),
        ("open_loop/covid_test", {"object_scale_range": 0.8}, "object_scale_range"),
        (
            PICKING,
            {"workspace": ((0.3, 0.6), (-0.15, 0.15), (0.0, 0.02))},
            r"50 had an object outside .*'block' at z = 0.02\d+ m, above 0.02 m",
        ),
    ],
)
def test_parameters_without_a_meaning_are_refused(make, task, settings, message):
    with pytest.raises(ConfigError, match=message):
        make(task, **settings)


def test_a_parameter_of_other_tasks_names_them_and_passes_at_its_default(make):
    with pytest.raises(ConfigError, match=r"parameter of .*open_loop/block_stacking"):
        make(PICKING, object_type="cylinder")
    env = make(PICKING, object_type="cube", object_set="random", obs_size=16)
    assert not hasattr(env.config, "object_type")


def test_a_task_may_need_components_of_the_action(make, monkeypatch):
    monkeypatch.setattr(TASKS[PICKING], "required_action_components", frozenset({"rz"}))
    with pytest.raises(ConfigError, match="cannot be solved without the components rz"):
        make(PICKING, action_sequence="pxyz")
    make(PICKING, obs_size=16).close()


def test_a_task_may_have_a_default_action_sequence(make, monkeypatch):
    monkeypatch.setattr(TASKS[PICKING], "default_action_sequence", "pxyz")
    env = make(PICKING, obs_size=16)
    assert env.action_spec.shape == (4,)
    assert resolve_env(PICKING, {}).config.action_sequence == "pxyz"
    given = {"action_sequence": "pxyzr"}
    assert resolve_env(PICKING, given).config.action_sequence == "pxyzr"
