"""Scenes of a floor and the pieces of a structure, without a robot."""

import math

import numpy as np

from ba_torchrl.sim.meshes import gable_mesh
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.tasks.structures.assignment import SlotAssigner, read_piece_states
from ba_torchrl.tasks.structures.blueprint import Blueprint, Slot, Span
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.moves import Grasps
from ba_torchrl.tasks.structures.pieces import CUBE, CUBOID, ROOF
from ba_torchrl.tasks.structures.planner import next_move
from ba_torchrl.tasks.terrain.flat import Flat
from ba_torchrl.tasks.workspace import Area, Workspace

B = 0.03
SPAN = Span(1.5 * B, 1.75 * B, 2.2 * B)
REGION = Area((0.3, 0.6), (-0.15, 0.15))
AREA = PlacementArea(Flat(None, Workspace(*REGION.bounds, (0.0, 0.4))), REGION, REGION, gap_m=B)
SHAPES = {
    "cube": Box(size_m=(B, B, B)),
    "cuboid": Box(size_m=(B, 4 * B, B)),
    "roof": Solid(parts=(gable_mesh((B, 4 * B, B), eaves_m=B / 4),)),
    "triangle": Solid(parts=(gable_mesh((B, B, B)),)),
}
BRIDGE = Blueprint((Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1), span=SPAN, stays_clear=True)))
TWO_STOREYS = Blueprint(
    (
        Slot(CUBE),
        Slot(CUBE),
        Slot(CUBOID, on=(0, 1), span=SPAN),
        Slot(ROOF, on=(2,), centered_over=(0, 1), stays_clear=True),
    )
)
THREE_STOREYS = Blueprint(
    (
        Slot(CUBE),
        Slot(CUBE),
        Slot(CUBOID, on=(0, 1), span=SPAN),
        Slot(CUBE, on=(2,)),
        Slot(CUBE, on=(2,)),
        Slot(ROOF, on=(3, 4), span=SPAN, stays_clear=True),
    )
)


class Scene:
    """A world with the pieces of a blueprint and spare ones, without a robot."""

    def __init__(self, world, blueprint, **spare):
        self.world = world
        self.bodies = {}
        for kind in dict.fromkeys(slot.piece.kind for slot in blueprint.slots):
            count = sum(slot.piece.kind == kind for slot in blueprint.slots) + spare.get(kind, 0)
            self.bodies[kind] = [world.add(SHAPES[kind], f"{kind} {i}") for i in range(count)]
        kinds = {slot.piece.kind: slot.piece for slot in blueprint.slots}
        pieces = {body: kinds[kind] for kind, bodies in self.bodies.items() for body in bodies}
        self.blueprint, self.pieces, self.ground = blueprint, pieces, frozenset((world.floor,))
        self.cubes = self.bodies.get("cube", [])
        self.scatter(np.random.default_rng(0))

    def assigner(self, held=None):
        states = read_piece_states(self.world, self.pieces, self.ground, self.ground, B)
        return SlotAssigner(self.blueprint, self.pieces, states, B, held)

    def is_built(self, held=None):
        return all(self.assigner(held).evaluate().values())

    def next_move(self, held=None, grasps=None):
        return next_move(self.assigner(held), AREA, grasps or Grasps())

    @property
    def all(self):
        return [body for bodies in self.bodies.values() for body in bodies]

    def scatter(self, rng):
        """Place all pieces upright on the floor, apart from each other."""
        cells = [(0.32 + 0.13 * i, -0.12 + 0.08 * j) for i in range(3) for j in range(4)]
        chosen = rng.permutation(len(cells))[: len(self.all)]
        for body, i in zip(self.all, chosen, strict=True):
            long = body.shape.bounds_m[1][1] > B
            yaw = math.pi / 2 if long else rng.uniform(-math.pi, math.pi)
            body.place((*cells[i], 0.015), yaw)
        self.settle()

    def put(self, body, x, y, level, yaw=0.0):
        body.place((x, y, (level + 0.5) * B), yaw)

    def settle(self):
        self.world.step()
        assert self.world.settle()

    def play(self, held=None, most=20):
        """Carry out moves until none is left; return them."""
        moves = []
        while (move := self.next_move(held)) is not None:
            moves.append(move)
            assert len(moves) <= most, moves
            move.body.place(
                move.position,
                move.piece.yaw_rad(move.body) if move.yaw_rad is None else move.yaw_rad,
            )
            held = None
            self.settle()
        return moves


def rotate(body, axis, angle_rad, yaw_rad):
    """Rotate a body about an axis of the world, after a yaw."""
    half, yaw = angle_rad / 2, yaw_rad / 2
    (x, y, z), w = (a * math.sin(half) for a in axis), math.cos(half)
    c, s = math.cos(yaw), math.sin(yaw)
    # product of the two quaternions, the yaw first
    body.set_pose((0.4, 0.0, 0.1), (x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s))
