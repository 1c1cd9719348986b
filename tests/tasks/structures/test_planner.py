"""Structures on hand-placed scenes: a floor and pieces, no robot."""

import itertools
import math

import numpy as np
import pytest

from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.sim.meshes import gable_mesh
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.structures.blocking import GraspQueries
from ba_torchrl.tasks.structures.blueprint import (
    CUBE,
    CUBOID,
    ROOF,
    TRIANGLE,
    Blueprint,
    Piece,
    Slot,
    Span,
    tower,
)
from ba_torchrl.tasks.structures.free_space import PlacementArea
from ba_torchrl.tasks.structures.planner import StructurePlanner

B = 0.03
SPAN = Span(1.5 * B, 1.75 * B, 2.2 * B)
AREA = PlacementArea((0.3, 0.6), (-0.15, 0.15), gap_m=B, height_m=lambda xy: 0.0)

SHAPES = {
    "cube": Box(size_m=(B, B, B)),
    "cuboid": Box(size_m=(B, 4 * B, B)),
    "roof": Solid(parts=(gable_mesh((B, 4 * B, B), eaves_m=B / 4),)),
    "triangle": Solid(parts=(gable_mesh((B, B, B)),)),
}

BRIDGE = Blueprint((Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1), span=SPAN, stays_free=True)))
TWO_STOREYS = Blueprint(
    (
        Slot(CUBE),
        Slot(CUBE),
        Slot(CUBOID, on=(0, 1), span=SPAN),
        Slot(ROOF, on=(2,), over=(0, 1), stays_free=True),
    )
)
THREE_STOREYS = Blueprint(
    (
        Slot(CUBE),
        Slot(CUBE),
        Slot(CUBOID, on=(0, 1), span=SPAN),
        Slot(CUBE, on=(2,)),
        Slot(CUBE, on=(2,)),
        Slot(ROOF, on=(3, 4), span=SPAN, stays_free=True),
    )
)


class Scene:
    """A world with the pieces of a blueprint, and spare ones, scattered about."""

    def __init__(self, world, blueprint, **spare):
        self.world = world
        self.bodies = {}
        for kind in dict.fromkeys(slot.piece.kind for slot in blueprint.slots):
            count = sum(slot.piece.kind == kind for slot in blueprint.slots) + spare.get(kind, 0)
            self.bodies[kind] = [world.add(SHAPES[kind], f"{kind} {i}") for i in range(count)]
        kinds = {slot.piece.kind: slot.piece for slot in blueprint.slots}
        pieces = {body: kinds[kind] for kind, bodies in self.bodies.items() for body in bodies}
        self.planner = StructurePlanner(blueprint, world, pieces, B)
        self.cubes = self.bodies.get("cube", [])
        self.scatter(np.random.default_rng(0))

    @property
    def all(self):
        return [body for bodies in self.bodies.values() for body in bodies]

    def scatter(self, rng):
        """Upright on the floor, apart from each other."""
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
        """Carry out the moves as they come; return them."""
        moves = []
        while (move := self.planner.next_move(AREA, held)) is not None:
            moves.append(move)
            assert len(moves) <= most, moves
            move.body.place(
                move.position,
                move.piece.yaw_rad(move.body) if move.yaw_rad is None else move.yaw_rad,
            )
            held = None
            self.settle()
        return moves


@pytest.fixture
def scene():
    with World() as world:
        yield lambda blueprint, **spare: Scene(world, blueprint, **spare)


# -- blueprints --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("slots", "message"),
    [
        ((Slot(CUBE, on=(0,)),), "after"),
        ((Slot(CUBE, on=(1,)), Slot(CUBE)), "after"),
        ((Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1))), "span"),
        ((Slot(CUBE), Slot(CUBE, on=(0,), span=SPAN)), "span"),
        ((Slot(CUBE), Slot(CUBE), Slot(CUBE), Slot(ROOF, on=(0, 1, 2), span=SPAN)), "one or two"),
        ((Slot(CUBE), Slot(ROOF, on=(0, 0), span=SPAN)), "one or two"),
        ((Slot(CUBE), Slot(CUBE, on=(0,)), Slot(ROOF, on=(0, 1), span=SPAN)), "the same"),
    ],
)
def test_impossible_blueprints_are_refused(slots, message):
    with pytest.raises(ValueError, match=message):
        Blueprint(slots)


@pytest.mark.parametrize(
    ("blueprint", "steps"),
    [
        (tower(CUBE, CUBE), 2),
        (tower(CUBE, CUBE, CUBE, CUBE), 6),
        (tower(CUBE, CUBE, CUBE, TRIANGLE), 6),
        (BRIDGE, 4),
        (TWO_STOREYS, 6),
        (THREE_STOREYS, 10),
        (Blueprint((Slot(CUBE), Slot(CUBE, on=(0,)), Slot(CUBE), Slot(CUBE, on=(2,)))), 4),
    ],
)
def test_optimal_steps_are_the_papers(blueprint, steps):
    assert blueprint.optimal_steps == steps


def test_a_building_needs_enough_bodies():
    with World() as world:
        cube = world.add(SHAPES["cube"], "cube")
        with pytest.raises(ValueError, match="needs 2 of 'cube'"):
            StructurePlanner(tower(CUBE, CUBE), world, {cube: CUBE}, B)


# -- pieces ------------------------------------------------------------------------------------


def turned(body, axis, angle_rad, yaw_rad):
    """Turn a body about an axis of the world, after a yaw."""
    half, yaw = angle_rad / 2, yaw_rad / 2
    (x, y, z), w = (a * math.sin(half) for a in axis), math.cos(half)
    c, s = math.cos(yaw), math.sin(yaw)
    # the product of the two quaternions, the yaw first
    body.set_pose((0.4, 0.0, 0.1), (x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s))


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("angle", [0.0, math.pi / 2, math.pi, -math.pi / 2])
def test_a_cube_has_a_heading_whichever_side_is_up(scene, axis, angle):
    cube = scene(tower(CUBE)).cubes[0]
    for yaw in (-1.2, 0.3, 2.0):
        # a cube with this yaw, tumbled by quarter turns about its own axes
        turned(cube, (0.0, 0.0, 1.0), yaw, 0.0)
        c, s = math.cos(yaw), math.sin(yaw)
        own = (axis[0] * c - axis[1] * s, axis[0] * s + axis[1] * c, 0.0)
        turned(cube, own, angle, yaw)
        assert CUBE.tilt_rad(cube) == pytest.approx(0.0, abs=1e-6)
        difference = (CUBE.yaw_rad(cube) - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
        assert difference == pytest.approx(0.0, abs=1e-6)


def test_a_long_piece_lies_on_its_sides_but_does_not_stand_on_its_end(scene):
    cuboid = scene(tower(CUBOID)).bodies["cuboid"][0]
    turned(cuboid, (0.0, 1.0, 0.0), math.pi / 2, 0.0)  # rolled about its length
    assert CUBOID.tilt_rad(cuboid) == pytest.approx(0.0, abs=1e-6)
    assert CUBOID.yaw_rad(cuboid) == pytest.approx(0.0, abs=1e-6)
    turned(cuboid, (1.0, 0.0, 0.0), math.pi / 2, 0.0)
    assert CUBOID.tilt_rad(cuboid) == pytest.approx(math.pi / 2)


def test_only_what_must_stay_upright_tips(scene):
    s = scene(tower(CUBE, TRIANGLE))
    triangle = s.bodies["triangle"][0]
    for angle, tipped in ((math.pi / 9 - 0.02, False), (math.pi / 9 + 0.02, True)):
        turned(triangle, (0.0, 1.0, 0.0), angle, 0.0)
        assert s.planner.has_tipped() is tipped
    assert not s.planner.has_tipped(held=triangle)
    turned(s.cubes[0], (0.0, 1.0, 0.0), 0.7, 0.0)
    s.put(triangle, 0.4, 0.1, 0)
    assert not s.planner.has_tipped()  # a cube on its edge falls on a side as good as any


# -- goals -------------------------------------------------------------------------------------


def test_a_stack_holds_within_half_a_block(scene):
    s = scene(tower(CUBE, CUBE))
    lower, upper = s.cubes
    for dx, dy, expected in (
        (0.0, 0.0, True),
        (0.014, -0.014, True),
        (0.016, 0.0, False),
        (0.0, -0.016, False),
    ):
        s.put(lower, 0.4, 0.0, 0)
        s.put(upper, 0.4 + dx, dy, 1, yaw=0.4)
        s.world.step()
        assert s.planner.is_built() is expected, (dx, dy)


def test_a_stack_needs_contact_and_free_hands(scene):
    s = scene(tower(CUBE, CUBE, CUBE))
    for order in itertools.permutations(s.cubes):
        for level, cube in enumerate(order):
            s.put(cube, 0.4, 0.0, level)
        s.world.step()
        assert s.planner.is_built()
        assert not any(s.planner.is_built(held=cube) for cube in s.cubes)
    top = order[2]
    top.place((0.4, 0.0, 2.5 * B + 0.003))
    s.world.step()
    assert not s.planner.is_built()
    s.put(top, 0.4 + B, 0.0, 1)  # beside the second, resting on nothing
    s.world.step()
    assert not s.planner.is_built()


def test_side_by_side_is_no_stack(scene):
    s = scene(tower(CUBE, CUBE))
    s.put(s.cubes[0], 0.4, 0.0, 0)
    s.put(s.cubes[1], 0.4 + B, 0.0, 0)
    s.settle()
    assert not s.planner.is_built()


def test_the_triangle_belongs_on_top_and_upright(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    first, second = s.cubes
    triangle = s.bodies["triangle"][0]
    s.put(first, 0.4, 0.0, 0)
    s.put(second, 0.4, 0.0, 1)
    s.settle()
    assert not s.planner.is_built()  # it lies on the floor
    s.put(triangle, 0.4, 0.0, 2, yaw=1.0)
    s.settle()
    assert s.planner.is_built()
    assert s.planner.next_move(AREA) is None
    # on its slope, with the centre where it was
    slope = math.pi - math.atan2(B, B / 2)
    turned(triangle, (0.0, 1.0, 0.0), slope, 0.0)
    depth = triangle.position[2] - vertical_extent(triangle)[0]
    triangle.set_pose((0.4, 0.0, 2 * B + depth), triangle.pose[1])
    s.settle()
    assert triangle.touches(second)
    assert not s.planner.is_built()
    s.put(triangle, 0.4, 0.0, 1)
    s.put(second, 0.5, 0.1, 0)
    s.settle()
    assert not s.planner.is_built()  # a storey is missing


def bridge_scene(scene, roof_offset=0.0, spacing=1.75 * B, bearing=0.6):
    s = scene(BRIDGE)
    c, sn = math.cos(bearing), math.sin(bearing)
    for cube, side in zip(s.cubes, (-0.5, 0.5), strict=True):
        s.put(cube, 0.45 + side * spacing * c, side * spacing * sn, 0, yaw=bearing)
    roof = s.bodies["roof"][0]
    s.put(roof, 0.45 + roof_offset * c, roof_offset * sn, 1, yaw=bearing - math.pi / 2)
    s.world.step()
    return s, roof


def test_a_bridge_rests_on_both_over_their_middle(scene):
    s, roof = bridge_scene(scene)
    s.settle()
    assert s.planner.is_built()
    assert not s.planner.is_built(held=roof)


@pytest.mark.parametrize(("offset", "expected"), [(0.029, True), (0.031, False), (2.6 * B, False)])
def test_a_bridge_may_be_off_the_middle_by_less_than_a_block(scene, offset, expected):
    s, _ = bridge_scene(scene, roof_offset=offset)
    assert s.planner.is_built() is expected


def test_a_bridge_over_a_gap_too_wide_is_none(scene):
    s, _ = bridge_scene(scene, spacing=5.2 * B)
    assert not s.planner.is_built()


def test_nothing_may_lie_on_what_stays_free(scene):
    s = scene(tower(CUBE, CUBE), cube=1)
    for level, cube in enumerate(s.cubes):
        s.put(cube, 0.4, 0.0, level)
    s.settle()
    assert not s.planner.is_built()
    (move,) = s.play()
    assert move.body is s.cubes[2]
    assert move.onto == ()
    assert s.planner.is_built()


# -- moves -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "blueprint",
    [
        tower(CUBE, CUBE),
        tower(CUBE, CUBE, CUBE, CUBE),
        tower(CUBE, TRIANGLE),
        tower(CUBE, CUBE, CUBE, TRIANGLE),
        BRIDGE,
        TWO_STOREYS,
        THREE_STOREYS,
    ],
    ids=["2", "4", "house of 2", "house 1", "house 2", "house 3", "house 4"],
)
def test_the_moves_build_it_in_the_fewest_steps(scene, blueprint):
    s = scene(blueprint)
    for seed in range(5):
        s.scatter(np.random.default_rng(seed))
        assert not s.planner.is_built()
        moves = s.play()
        assert s.planner.is_built()
        assert 2 * len(moves) == blueprint.optimal_steps


def test_a_move_says_where_and_how(scene):
    s = scene(tower(CUBE, TRIANGLE))
    (cube,), (triangle,) = s.bodies["cube"], s.bodies["triangle"]
    s.put(cube, 0.42, 0.05, 0, yaw=0.3)
    s.put(triangle, 0.5, -0.1, 0, yaw=-1.0)
    s.settle()
    before = [body.pose for body in s.all]
    move = s.planner.next_move(AREA)
    assert [body.pose for body in s.all] == before
    assert move.body is triangle
    assert move.onto == (cube,)
    assert move.position == pytest.approx((0.42, 0.05, 1.5 * B), abs=5e-4)
    quarter_turns = (move.yaw_rad - 0.3) / (math.pi / 2)
    assert quarter_turns == pytest.approx(round(quarter_turns), abs=1e-3)
    assert move.yaw_period_rad == pytest.approx(math.pi / 2)


def test_a_leaning_tower_is_balanced(scene):
    """Straight over a cube that hangs out by 14 of its 30 mm, the next would tip it."""
    s = scene(tower(CUBE, CUBE, CUBE))
    base, leaning, loose = s.cubes
    s.put(base, 0.42, 0.05, 0)
    s.put(leaning, 0.434, 0.05, 1)
    s.put(loose, 0.5, -0.1, 0)
    s.settle()
    move = s.planner.next_move(AREA)
    assert (move.body, move.onto) == (loose, (leaning,))
    assert move.position[:2] == pytest.approx((0.427, 0.05), abs=1e-3)
    loose.place(move.position)
    s.settle()
    assert s.planner.is_built()


def test_two_short_towers_become_one_from_the_top_down(scene):
    s = scene(tower(CUBE, CUBE, CUBE, CUBE))
    for i, cube in enumerate(s.cubes):
        s.put(cube, 0.35 + 0.15 * (i // 2), 0.0, i % 2)
    s.settle()
    moves = s.play()
    assert len(moves) == 2
    tops = (s.cubes[1], s.cubes[3])
    assert moves[0].body in tops
    assert s.planner.is_built()


def test_a_triangle_too_low_is_taken_down_first(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    triangle = s.bodies["triangle"][0]
    s.put(s.cubes[0], 0.4, 0.0, 0)
    s.put(triangle, 0.4, 0.0, 1)
    s.put(s.cubes[1], 0.5, 0.1, 0)
    s.settle()
    moves = s.play()
    assert [move.piece.kind for move in moves] == ["triangle", "cube", "triangle"]
    assert moves[0].onto == ()
    assert s.planner.is_built()


def test_a_roof_on_one_cube_is_taken_down_before_the_cubes_move(scene):
    s = scene(BRIDGE)
    roof = s.bodies["roof"][0]
    s.put(s.cubes[0], 0.35, 0.0, 0)
    s.put(roof, 0.35, 0.0, 1)
    s.put(s.cubes[1], 0.55, 0.0, 0)
    s.settle()
    moves = s.play()
    assert [move.piece.kind for move in moves] == ["roof", "cube", "roof"]
    assert moves[0].onto == ()
    assert s.planner.is_built()


def test_cubes_come_to_the_distance_of_the_bridge_and_stay_there(scene):
    s = scene(BRIDGE)
    for spacing, moved in ((4 * B, True), (1.2 * B, True), (1.9 * B, False)):
        s.put(s.cubes[0], 0.45 - spacing / 2, 0.0, 0)
        s.put(s.cubes[1], 0.45 + spacing / 2, 0.0, 0)
        s.put(s.bodies["roof"][0], 0.45, 0.12, 0, yaw=math.pi / 2)
        s.settle()
        move = s.planner.next_move(AREA)
        assert (move.piece is CUBE) is moved
        if moved:
            (partner,) = (cube for cube in s.cubes if cube is not move.body)
            distance = math.dist(move.position[:2], partner.position[:2])
            assert distance == pytest.approx(SPAN.aim_m, abs=1e-6)


def test_what_is_held_is_placed_first(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    first, second = s.cubes
    triangle = s.bodies["triangle"][0]
    first.place((0.4, 0.0, 0.2))
    assert s.planner.next_move(AREA, held=first)[0] is first
    assert s.planner.next_move(AREA, held=first).onto == (second,)
    s.scatter(np.random.default_rng(1))
    triangle.place((0.45, 0.0, 0.2))
    move = s.planner.next_move(AREA, held=triangle)
    assert move.body is triangle
    assert move.onto == ()  # its place is not there yet


def test_pieces_are_put_down_inside_and_clear_of_others(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    triangle = s.bodies["triangle"][0]
    for seed in range(10):
        s.scatter(np.random.default_rng(seed))
        triangle.place((0.6, 0.15, 0.2))
        x, y, z = s.planner.next_move(AREA, held=triangle).position
        assert AREA.x[0] <= x <= AREA.x[1]
        assert AREA.y[0] <= y <= AREA.y[1]
        assert z == pytest.approx(B / 2, abs=1e-6)
        room = B / math.sqrt(2)  # of each
        for cube in s.cubes:
            assert math.dist((x, y), cube.position[:2]) >= 2 * room + AREA.gap_m - 1e-9


def test_effort_decides_among_equals(scene):
    s = scene(tower(CUBE, CUBE, CUBE))
    queries = GraspQueries()
    for favourite in s.cubes:
        queries.pick_effort_m = lambda body, f=favourite: float(body is not f)
        move = s.planner.next_move(AREA, queries=queries)
        assert move.body is favourite


def test_what_keeps_the_hand_from_a_piece_goes_to_the_ground(scene):
    """A stack of three stands beside the fourth: the hand reaches it beside a single cube only."""
    s = scene(tower(*[CUBE] * 4))
    for level, cube in enumerate(s.cubes[:3]):
        s.put(cube, 0.45, 0.0, level)
    loose = s.cubes[3]
    s.put(loose, 0.45, 1.1 * B, 0)
    s.world.settle()

    class Queries(GraspQueries):
        clears_blocked_pieces = True

        def blocks_grasp(self, body, other, place):
            x, y, z = other.position if place is None else place
            near = math.dist((x, y), body.position[:2]) < 2 * B
            return [near and z - body.position[2] > B / 2]

    assert s.planner.next_move(AREA).body is loose
    for top in (s.cubes[2], s.cubes[1]):
        move = s.planner.next_move(AREA, queries=Queries())
        assert move.body is top
        assert move.onto == ()
        top.place(move.position)
        s.world.settle()
    assert s.planner.next_move(AREA, queries=Queries()).onto != ()
    # nor is anything put where it would be in the way
    move = s.planner.next_move(AREA, held=s.cubes[2], queries=Queries())
    assert move.body is s.cubes[2]
    assert move.onto == (s.cubes[1],)


def test_a_structure_may_have_to_stand_on_something_else_than_the_floor():
    with World() as world:
        platform = world.add(Box(size_m=(0.2, 0.2, 0.02), mass_kg=0.0), "platform")
        platform.place((0.45, 0.0, 0.01))
        cubes = [world.add(SHAPES["cube"], f"cube {i}") for i in range(2)]
        pieces = dict.fromkeys(cubes, CUBE)
        planner = StructurePlanner(
            tower(CUBE, CUBE), world, pieces, B, support_ids=frozenset({platform.id})
        )
        for base, expected in ((0.0, False), (0.02, True)):
            x = 0.45 if base else 0.7
            for level, cube in enumerate(cubes):
                cube.place((x, 0.0, base + (level + 0.5) * B))
            world.step()
            assert planner.is_built() is expected


def test_a_piece_is_data():
    assert Piece("disc", 0.0) == Piece("disc", 0.0)
    assert len({CUBE, CUBOID, ROOF, TRIANGLE}) == 4
