"""Arrangements of tubes and swabs, and steps that test them."""

import itertools
import math

import numpy as np
import torch

from ba_torchrl.actions import PLACE, PickPlaceCommand
from ba_torchrl.tasks.open_loop.covid_test import USED_BOX

TASK = "open_loop/covid_test"
FIXED = {"random_orientation": False, "action_sequence": "pxy"}


def step(env, action):
    """Take a step with an action vector or a command."""
    if isinstance(action, PickPlaceCommand):
        action = env.actions.encode(action)
    return env.step(env.full_action_spec.zero().set("action", torch.as_tensor(action)))["next"]


def wait(env):
    """Take a step that moves no object: a place with an empty gripper."""
    assert env.scene.task.robot.held_body() is None
    return step(env, PickPlaceCommand(PLACE, 0.3, 0.0, 0.1))


def follow(env, count):
    """Take expert actions; return the last state."""
    for _ in range(count):
        state = step(env, env._expert_action(env.scene))
    return state


def lay(task, body, area, spot, along=math.pi / 2):
    """Place a tube or swab on the floor of an area, with position and yaw in the area's frame."""
    task.layout.lay(body, task.layout.to_world(area, spot), area.yaw_rad + along)


def outline(task, area, size):
    """Return the corners of an area."""
    signs = itertools.product((-0.5, 0.5), repeat=2)
    return np.array([task.layout.to_world(area, (s * size[0], t * size[1])) for s, t in signs])


def lay_pair(task, tube=0, swab=0):
    """Lay a tube and a swab into the test area."""
    lay(task, task.tubes[tube], task.layout.test_area, (0.0, 0.06))
    lay(task, task.swabs[swab], task.layout.test_area, (0.0, -0.06))


def local(area, point):
    """Return x and y of a point in an area's frame."""
    dx, dy = (p - a for p, a in zip(point[:2], area.position[:2], strict=True))
    cos, sin = math.cos(area.yaw_rad), math.sin(area.yaw_rad)
    return cos * dx + sin * dy, cos * dy - sin * dx


def misplace(task, tube, where):
    """Place a used tube outside its box."""
    if where == "new_box":
        lay(task, tube, task.layout.new_box, (0.0, 0.04))
    elif where == "across the rim":  # across the corner, its centre above the inside
        rim = USED_BOX.size[2] + tube.shape.size_m[2] / 2
        x, y = task.layout.to_world(task.layout.used_box, (0.037, 0.027))
        tube.place((x, y, rim), task.layout.used_box.yaw_rad - math.atan2(0.046, 0.056))
    else:
        lay(task, tube, task.layout.used_box, (0.0, 0.064), along=0.0)


def carry_out_tests(env, rounds=3):
    """Carry out tests, with the used tubes side by side in their box."""
    task = env.scene.task
    for i in range(rounds):
        lay_pair(task, i, i)
        state = wait(env)
        assert not state["done"]
        assert len(task.get_state().used_tubes) == i + 1
        if i < rounds - 1:
            lay(task, task.tubes[i], task.layout.used_box, (0.0, 0.024 * i - 0.024), along=0.0)
    return task


def poses(env):
    return [body.pose for body in env.scene.world.bodies]
