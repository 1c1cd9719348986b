"""Refused parameters of an environment, with messages that state the allowed values."""

import math

import pytest

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import TASKS

PICKING = "close_loop/block_picking"


def test_render_needs_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="DISPLAY"):
        ba_torchrl.make(PICKING, render=True)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"in_hand_size": 40}, "open-loop"),
        ({"object_set": "household"}, "no meaning"),
        ({"asset_root": "somewhere"}, "no meaning"),
        ({"object_type": "cylinder"}, "no meaning"),
        ({"num_objects": 2}, "takes 1 "),
        ({"solver_iterations": 10}, "physics_mode='custom'"),
        ({"physics_mode": "custom"}, "time_step_s"),
        ({"floor_color": (0.1, 0.2)}, "red, green and blue"),
        ({"workspace_color": (0.1, 0.2, 2.0)}, "red, green and blue"),
        ({"view_type": "from_below"}, "camera_center_xyz"),
        ({"num_object": 2}, "Did you mean 'num_objects'"),
        ({"drot": math.inf}, "finite"),
        ({"dpos": math.nan}, "dpos"),
        ({"view_scale": math.inf}, "finite"),
        ({"action_sequence": ""}, "pxyzr"),
        (
            {"workspace": ((0.3, 0.6), (-0.15, 0.15), (0.0, 0.02))},
            r"50 had an object outside .*'block' at z = 0.02\d+ m, above 0.02 m",
        ),
    ],
)
def test_parameters_without_a_meaning_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        ba_torchrl.make(PICKING, **settings)


def test_a_value_that_the_tasks_own_parameter_does_not_take_is_refused():
    with pytest.raises(ConfigError, match="'cube' or 'cylinder'"):
        ba_torchrl.make("open_loop/block_stacking", object_type="ball")


def test_a_parameter_of_other_tasks_names_them_and_passes_at_its_default():
    with pytest.raises(ConfigError, match=r"parameter of .*open_loop/block_stacking"):
        ba_torchrl.make(PICKING, object_type="cylinder")
    env = ba_torchrl.make(PICKING, object_type="cube", object_set="random", obs_size=16)
    assert not hasattr(env.config, "object_type")
    env.close()


def test_a_task_may_need_components_of_the_action(monkeypatch):
    monkeypatch.setattr(TASKS[PICKING], "required_action_components", frozenset({"rz"}))
    with pytest.raises(ConfigError, match="cannot be solved without the components rz"):
        ba_torchrl.make(PICKING, action_sequence="pxyz")
    ba_torchrl.make(PICKING, obs_size=16).close()


def test_a_task_may_have_a_default_action_sequence(monkeypatch):
    monkeypatch.setattr(TASKS[PICKING], "default_action_sequence", "pxyz")
    env = ba_torchrl.make(PICKING, obs_size=16)
    assert env.action_spec.shape == (4,)
    assert resolve_env(PICKING, {}).config.action_sequence == "pxyz"
    given = {"action_sequence": "pxyzr"}
    assert resolve_env(PICKING, given).config.action_sequence == "pxyzr"
    env.close()
