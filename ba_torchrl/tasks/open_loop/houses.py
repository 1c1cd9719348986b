"""House Building 1 to 4 and Improvise House Building 2 and 3 (appendix A.1)."""

from __future__ import annotations

from dataclasses import replace

from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot, tower
from ba_torchrl.tasks.structures.improvise import START_GAP_M, any_cuboid, any_shape, shape_span
from ba_torchrl.tasks.structures.open_loop import StructureTask
from ba_torchrl.tasks.structures.pieces import cube, cuboid, pair_span, roof, triangle


@TASKS.register("open_loop/house_building_1")
class HouseBuilding1(StructureTask):
    """Objects: one to five cubes of 3 cm, three by default, and a triangle of 3 cm.

    Goal: the cubes form a stack with the triangle on top, and nothing is held. The episode ends
    early when the triangle tips over or a piece leaves the workspace. Paper, appendix A.1.
    """

    num_objects = 4
    num_objects_range = (2, 6)

    def blueprint(self) -> Blueprint:
        """Return the stack with the triangle."""
        cubes = [cube(self.block_m)] * (self.settings.num_objects - 1)
        return tower(*cubes, triangle(self.block_m))


@TASKS.register("open_loop/house_building_2")
class HouseBuilding2(StructureTask):
    """Objects: two cubes of 3 cm and a roof of 3 x 12 x 3 cm.

    Goal: the roof lies on both cubes, and nothing is held. The episode ends early when the roof
    tips over or a piece leaves the workspace. Paper, appendix A.1.
    """

    num_objects = 3
    num_objects_range = (3, 3)

    def blueprint(self) -> Blueprint:
        """Return two cubes that support the roof."""
        block = cube(self.block_m)
        across = Slot(roof(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.0))
        return Blueprint((Slot(block), Slot(block), across))


@TASKS.register("open_loop/house_building_3")
class HouseBuilding3(StructureTask):
    """Objects: two cubes of 3 cm, a cuboid and a roof of 3 x 12 x 3 cm.

    Goal: the cuboid lies on both cubes and the roof on the cuboid, both centred over the cubes, and
    nothing is held. The episode ends early when the roof tips over or a piece leaves the workspace.
    Paper, appendix A.1.
    """

    scale_limits = (0.55, 0.9)
    num_objects = 4
    num_objects_range = (4, 4)

    def blueprint(self) -> Blueprint:
        """Return two cubes that support the cuboid, which supports the roof."""
        block = cube(self.block_m)
        return Blueprint(
            (
                Slot(block),
                Slot(block),
                Slot(cuboid(self.block_m), on=(0, 1), span=pair_span(self.block_m, 2.2)),
                Slot(roof(self.block_m), on=(2,), centered_over=(0, 1)),
            )
        )


@TASKS.register("open_loop/house_building_4")
class HouseBuilding4(StructureTask):
    """Objects: four cubes of 3 cm, a cuboid and a roof of 3 x 12 x 3 cm.

    Goal: two cubes support the cuboid, which supports the other two cubes, which support the roof,
    and nothing is held. The episode ends early when the roof tips over or a piece leaves the
    workspace. Paper, appendix A.1.
    """

    scale_limits = (0.55, 0.66)
    max_steps = 20
    num_objects = 6
    num_objects_range = (6, 6)

    def blueprint(self) -> Blueprint:
        """Return the two storeys and the roof."""
        block, span = cube(self.block_m), pair_span(self.block_m, 2.3)
        return Blueprint(
            (
                Slot(block),
                Slot(block),
                Slot(cuboid(self.block_m), on=(0, 1), span=span),
                Slot(block, on=(2,)),
                Slot(block, on=(2,)),
                Slot(roof(self.block_m), on=(3, 4), span=span),
            )
        )


@TASKS.register("open_loop/improvise_house_building_2")
class ImproviseHouseBuilding2(StructureTask):
    """Objects: two random shapes, 2.5 to 3 cm high, and a roof of 3 x 12 x 3 cm.

    Goal: the roof lies on both shapes, and nothing is held. The episode ends early when a shape or
    the roof tips over or leaves the workspace. Paper, appendix A.1.
    """

    num_objects = 3
    num_objects_range = (3, 3)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0

    def blueprint(self) -> Blueprint:
        """Return two shapes that support the roof."""
        shape = any_shape()
        across = Slot(replace(roof(self.block_m), spacing=None), on=(0, 1), span=shape_span())
        return Blueprint((Slot(shape), Slot(shape), across))


@TASKS.register("open_loop/improvise_house_building_3")
class ImproviseHouseBuilding3(StructureTask):
    """Objects: two random shapes, 2.5 to 3 cm high, a random cuboid and a roof of 3 x 12 x 3 cm.

    Goal: the cuboid lies on both shapes and the roof on the cuboid, both centred over the shapes,
    and nothing is held. The episode ends early when a shape or the roof tips over, or a piece
    leaves the workspace. Paper, appendix A.1.
    """

    scale_limits = (0.55, 0.9)
    num_objects = 4
    num_objects_range = (4, 4)
    start_gap_m = START_GAP_M
    least_pick_blocks = 0.0
    equal_moves = 16

    def blueprint(self) -> Blueprint:
        """Return two shapes that support the cuboid, which supports the roof."""
        shape = any_shape()
        return Blueprint(
            (
                Slot(shape),
                Slot(shape),
                Slot(any_cuboid(), on=(0, 1), span=shape_span()),
                Slot(replace(roof(self.block_m), spacing=None), on=(2,), centered_over=(0, 1)),
            )
        )
