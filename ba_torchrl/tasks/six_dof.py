"""The open-loop tasks in six degrees of freedom: structures on a terrain with slopes (appendix C).

Each is a task on level ground with another terrain. A row of `VARIANTS` adds one.
"""

from __future__ import annotations

import math
from typing import Any

from ba_torchrl.tasks.base import TASKS, OpenLoopTask
from ba_torchrl.tasks.open_loop.block_stacking import BlockStacking
from ba_torchrl.tasks.open_loop.box_palletizing import BoxPalletizing
from ba_torchrl.tasks.open_loop.houses import (
    HouseBuilding1,
    HouseBuilding2,
    HouseBuilding3,
    HouseBuilding4,
    ImproviseHouseBuilding2,
    ImproviseHouseBuilding3,
)
from ba_torchrl.tasks.terrain.bumps import Bumps
from ba_torchrl.tasks.terrain.ramps import Ramps

ON_SIDE_RAD = math.pi / 3
"""Tilt of a piece that has tipped over on a slope. No grasp turns it upright."""


def _ramps(task: OpenLoopTask) -> Ramps:
    """Load two ramps."""
    return Ramps(task.world, task.settings.workspace)


def _bumps(task: OpenLoopTask) -> Bumps:
    """Load the bumps and a platform of `platform_m`, the extents at the default scale."""
    unit = task.settings.scale / task.scale_range[0]
    return Bumps(
        task.world,
        task.settings.workspace,
        (unit * task.platform_m[0], unit * task.platform_m[1]),
        random_orientation=task.settings.random_orientation,
    )


ON_SLOPES: dict[str, Any] = {
    "default_action_sequence": "pxyzrrr",
    "default_in_hand_mode": "proj",
    "required_action_components": frozenset(("z", "rz", "ry", "rx")),
    "tipped_rad": ON_SIDE_RAD,
}
"""Attributes of every task on slopes."""
TERRAINS: dict[str, dict[str, Any]] = {
    "ramp": {**ON_SLOPES, "make_terrain": _ramps},
    "bump": {
        **ON_SLOPES,
        "make_terrain": _bumps,
        "platform_m": (0.13, 0.13),
        "default_in_hand_size": 40,  # appendix G.1
    },
}
"""Attributes of the tasks on each terrain, by the first part of their ids."""
DESCRIPTIONS = {
    "ramp": """with two ramps: the structure stands between them.

    The distance between the ramps is 4 to 20 cm, and at least what the pieces on the ground need.
    Their slopes are 0 to 30 degrees, the heights of their lower edges 0 to 1 cm.""",
    "bump": """on a platform of {0} x {1} cm, with a bumpy surface around it.

    All objects start on this surface, nine pyramids with slopes of 0 to 15 degrees.""",
}


VARIANTS: tuple[tuple[str, type[OpenLoopTask], dict[str, Any]], ...] = (
    ("ramp/block_stacking", BlockStacking, {}),
    ("ramp/house_building_1", HouseBuilding1, {}),
    ("ramp/house_building_2", HouseBuilding2, {}),
    ("ramp/house_building_3", HouseBuilding3, {}),
    ("ramp/house_building_4", HouseBuilding4, {}),
    ("ramp/improvise_house_building_2", ImproviseHouseBuilding2, {}),
    ("ramp/improvise_house_building_3", ImproviseHouseBuilding3, {}),
    ("bump/house_building_4", HouseBuilding4, {}),
    (
        "bump/box_palletizing",
        BoxPalletizing,
        # boxes and gripper have no room beside a larger platform
        {"platform_m": (0.24, 0.2), "scale_limits": (0.75, 0.85)},
    ),
)
"""Id, the same task on level ground, and further attributes in which the two differ."""


def task_on(task_id: str, level: type[OpenLoopTask], attributes: dict[str, Any]) -> type:
    """Return the task of a variant; its name is the terrain's and the level task's."""
    terrain, _, name = task_id.partition("/")
    attributes = {**TERRAINS[terrain], **attributes}
    size_cm = (f"{100 * size:g}" for size in attributes.get("platform_m", ()))
    description = f"""{name.replace("_", " ").title()} {DESCRIPTIONS[terrain].format(*size_cm)}
    Objects and goal are as in `open_loop/{name}`. The episode ends early when a piece that must
    stay upright lies on its side, or a piece leaves the workspace. Paper, appendix C.
    """
    own = {"__module__": __name__, "__doc__": description}
    name = f"{terrain.title()}{level.__name__}"
    return type(level)(name, (level,), {**attributes, **own})


for _id, _level, _attributes in VARIANTS:
    _task = TASKS.register(_id)(task_on(_id, _level, _attributes))
    globals()[_task.__name__] = _task  # where pickle finds it
