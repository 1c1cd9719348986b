"""A task, a robot and an observation as a user writes them."""

import torch
from torchrl.data import Unbounded

from ba_torchrl.envs.observations import OBSERVATIONS, Observation
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.close_loop.block_reaching import BlockReaching


@TASKS.register("mine/reach_near")
class ReachNear(BlockReaching):
    """Block reaching with a tolerance of 2 cm."""

    goal_distance_m = 0.02


@ROBOTS.register("mine/kuka")
class MyKuka(Kuka):
    """The Kuka arm under another name."""


@OBSERVATIONS.register("mine/opening")
class Opening(Observation):
    """The opening of the gripper, 0 to 1."""

    def specs(self, scene):
        """Return the specification of the opening."""
        return {"opening": Unbounded(shape=(1,), dtype=torch.float32)}

    def observe(self, scene):
        """Return the opening."""
        return {"opening": torch.tensor([scene.robot.opening()])}
