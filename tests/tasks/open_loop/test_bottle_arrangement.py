"""Bottle arrangement: when a bottle is arranged, and when the scene is invalid."""

import math

import pytest

from ba_torchrl.tasks.manipulation.footprints import Rectangle
from ba_torchrl.tasks.open_loop.bottle_arrangement import slots as bottle_slots
from tests.tasks.packing.scenes import BOTTLES


def arranged_bottles(make_env):
    """Return an environment with all bottles in their slots."""
    env = make_env(BOTTLES)
    env.reset()
    task = env.scene.task
    tray = Rectangle(*task.container.position[:2], task.container.yaw_rad, 0.0, 0.0)
    for body, slot in zip(task.objects, bottle_slots(), strict=True):
        body.place((*tray.frame.to_world(*slot), 0.005), 0.3)
    env.scene.world.settle()
    return env, task, tray


def test_a_bottle_lying_in_the_tray_ends_the_episode(make_env):
    _, task, tray = arranged_bottles(make_env)
    body = task.objects[1]
    lying = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    body.set_pose((*tray.frame.to_world(0.0, 0.0), 0.2), lying)
    assert not task.is_success()
    assert not task.is_valid()


@pytest.mark.parametrize(
    ("place", "z", "counts"),
    [
        ((-0.083, -0.041), 0.005, True),  # outside its slot
        ((0.147, 0.0), 0.0, False),  # outside, at the wall
        ((0.0, 0.106), 0.0, False),
        ((0.115, 0.0), 0.05, False),  # upright on the wall
        ((0.0, 0.0), 0.02, False),  # above the floor
    ],
)
def test_a_bottle_must_stand_on_the_floor_of_the_tray(make_env, place, z, counts):
    _, task, tray = arranged_bottles(make_env)
    assert task.is_success()
    assert task.is_valid()
    body = task.objects[0 if counts else 1]
    body.place((*tray.frame.to_world(*place), z), 0.0)
    assert task.stands_in_tray(body) is counts
    assert task.is_success() is counts


def test_tilted_bottles_return_upright(make_env):
    env = make_env(BOTTLES)
    env.reset()
    task = env.scene.task
    for body in task.objects:
        x, y, _ = body.position
        lean = math.radians(15)
        base = 0.026 * math.sin(lean)  # the lower edge stays above the surface
        body.set_pose((x, y, base), (math.sin(lean / 2), 0.0, 0.0, math.cos(lean / 2)))
    env.scene.world.settle(600)
    assert all(body.tilt_rad < 0.02 for body in task.objects)
