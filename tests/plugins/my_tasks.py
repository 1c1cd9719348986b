"""A task and a robot as a user writes them."""

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
