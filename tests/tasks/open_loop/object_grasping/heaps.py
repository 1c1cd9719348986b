"""Heaps of objects, and episodes on them."""

import torch

from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M

TASK = "open_loop/object_grasping"
CENTER = (0.45, 0.0)
NO_OP = torch.tensor([1.0, *CENTER, 0.0])
"""A place with an empty gripper: a failed episode that moves no object."""


def play(env, state, action=None):
    """Act until the episode ends, with expert actions or with the given one."""
    while not state["done"]:
        chosen = state["expert_action"] if action is None else action
        state = env.step(state.set("action", chosen))["next"]
    return state


def with_brick(make, **config):
    """Return an environment with a brick in the middle of the tray, 4 cm wide along x."""
    env = make(object_set="household", num_objects=1, action_sequence="pxyzr", **config)
    state, pool = env.reset(), env.scene.task.pool
    brick = next(body for body in pool.bodies if body.name == "brick")
    pool.clear()
    pool.activate(brick)
    brick.place((*CENTER, FLOOR_Z_M + 0.02))
    env.scene.world.settle()
    return env, state
