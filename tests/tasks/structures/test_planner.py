"""The moves that build a structure from any arrangement."""

import math

import numpy as np
import pytest

from ba_torchrl.tasks.structures.blueprint import tower
from ba_torchrl.tasks.structures.moves import Grasps
from ba_torchrl.tasks.structures.pieces import CUBE, TRIANGLE
from ba_torchrl.tasks.structures.planner import next_moves
from tests.tasks.structures.scenes import AREA, BRIDGE, SPAN, THREE_STOREYS, TWO_STOREYS, B


@pytest.mark.parametrize(
    ("blueprint", "steps"),
    [
        (tower(CUBE, CUBE), 2),
        (tower(CUBE, CUBE, CUBE, CUBE), 6),
        (tower(CUBE, TRIANGLE), 2),
        (tower(CUBE, CUBE, CUBE, TRIANGLE), 6),
        (BRIDGE, 4),
        (TWO_STOREYS, 6),
        (THREE_STOREYS, 10),
    ],
    ids=["2", "4", "house of 2", "house 1", "house 2", "house 3", "house 4"],
)
def test_the_moves_build_the_structure_in_the_papers_steps(scene, blueprint, steps):
    s = scene(blueprint)
    for seed in range(3):
        s.scatter(np.random.default_rng(seed))
        assert not s.is_built()
        moves = s.play()
        assert s.is_built()
        assert 2 * len(moves) == steps


def test_a_move_has_body_supports_position_and_yaw(scene):
    s = scene(tower(CUBE, TRIANGLE))
    (cube,), (triangle,) = s.bodies["cube"], s.bodies["triangle"]
    s.put(cube, 0.42, 0.05, 0, yaw=0.3)
    s.put(triangle, 0.5, -0.1, 0, yaw=-1.0)
    s.settle()
    before = [body.pose for body in s.all]
    move = s.next_move()
    assert [body.pose for body in s.all] == before
    assert move.body is triangle
    assert move.onto == (cube,)
    assert move.position == pytest.approx((0.42, 0.05, 1.5 * B), abs=5e-4)
    quarter_turns = (move.yaw_rad - 0.3) / (math.pi / 2)
    assert quarter_turns == pytest.approx(round(quarter_turns), abs=1e-3)
    assert move.yaw_period_rad == pytest.approx(math.pi / 2)


def test_pieces_alike_and_slots_alike_are_equally_good(scene):
    """Nothing is placed, three cubes lie around: the nearest pair comes first."""
    s = scene(THREE_STOREYS)
    s.scatter(np.random.default_rng(1))

    def moves(held=None):
        return next_moves(s.assigner(held), AREA, Grasps())

    found = moves()
    assert found[0] == s.next_move()
    assert {move.body for move in found} == set(s.cubes)
    while (move := s.next_move()) is not None and move.piece.kind != "cuboid":
        move.body.place(move.position)
        s.settle()
    assert [each.body for each in moves()] == s.bodies["cuboid"]  # no other piece is alike
    move.body.place(move.position, move.yaw_rad)
    s.settle()
    free = [cube for cube in s.cubes if cube not in s.assigner(None).placed()]
    assert {move.body for move in moves()} == set(free)
    assert [move.body for move in moves(free[0])] == free[:1]  # what is held is placed


def test_the_next_cube_balances_a_leaning_tower(scene):
    """Centred on a cube with an overhang of 14 of 30 mm, the next cube would tip it."""
    s = scene(tower(CUBE, CUBE, CUBE))
    base, leaning, loose = s.cubes
    s.put(base, 0.42, 0.05, 0)
    s.put(leaning, 0.434, 0.05, 1)
    s.put(loose, 0.5, -0.1, 0)
    s.settle()
    move = s.next_move()
    assert (move.body, move.onto) == (loose, (leaning,))
    assert move.position[:2] == pytest.approx((0.427, 0.05), abs=1e-3)
    loose.place(move.position)
    s.settle()
    assert s.is_built()


def test_two_towers_are_joined_from_the_top_down(scene):
    s = scene(tower(CUBE, CUBE, CUBE, CUBE))
    for i, cube in enumerate(s.cubes):
        s.put(cube, 0.35 + 0.15 * (i // 2), 0.0, i % 2)
    s.settle()
    first, _ = s.play()
    assert first.body in (s.cubes[1], s.cubes[3])
    assert s.is_built()


@pytest.mark.parametrize(
    ("blueprint", "kind"), [(tower(CUBE, CUBE, TRIANGLE), "triangle"), (BRIDGE, "roof")]
)
def test_a_piece_on_one_cube_is_removed_before_the_cubes_move(scene, blueprint, kind):
    s = scene(blueprint)
    s.put(s.cubes[0], 0.35, 0.0, 0)
    s.put(s.bodies[kind][0], 0.35, 0.0, 1)
    s.put(s.cubes[1], 0.55, 0.0, 0)
    s.settle()
    moves = s.play()
    assert [move.piece.kind for move in moves] == [kind, "cube", kind]
    assert moves[0].onto == ()
    assert s.is_built()


def test_cubes_move_to_the_span_of_the_bridge_once(scene):
    s = scene(BRIDGE)
    for spacing, moved in ((4 * B, True), (1.2 * B, True), (1.9 * B, False)):
        s.put(s.cubes[0], 0.45 - spacing / 2, 0.0, 0)
        s.put(s.cubes[1], 0.45 + spacing / 2, 0.0, 0)
        s.put(s.bodies["roof"][0], 0.45, 0.12, 0, yaw=math.pi / 2)
        s.settle()
        move = s.next_move()
        assert (move.piece is CUBE) is moved
        if moved:
            (partner,) = (cube for cube in s.cubes if cube is not move.body)
            distance = math.dist(move.position[:2], partner.position[:2])
            assert distance == pytest.approx(SPAN.aim_m, abs=1e-6)


def test_the_held_piece_is_placed_first(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    first, second = s.cubes
    triangle = s.bodies["triangle"][0]
    first.place((0.4, 0.0, 0.2))
    assert s.next_move(held=first)[0] is first
    assert s.next_move(held=first).onto == (second,)
    s.scatter(np.random.default_rng(1))
    triangle.place((0.45, 0.0, 0.2))
    move = s.next_move(held=triangle)
    assert move.body is triangle
    assert move.onto == ()  # its slot has no supports yet


def test_pieces_are_put_down_in_the_area_with_clearance(scene):
    s = scene(tower(CUBE, CUBE, TRIANGLE))
    triangle = s.bodies["triangle"][0]
    for seed in range(10):
        s.scatter(np.random.default_rng(seed))
        triangle.place((0.6, 0.15, 0.2))
        x, y, z = s.next_move(held=triangle).position
        assert AREA.aside.x[0] <= x <= AREA.aside.x[1]
        assert AREA.aside.y[0] <= y <= AREA.aside.y[1]
        assert z == pytest.approx(B / 2, abs=1e-6)
        half_diagonal = B / math.sqrt(2)  # of each cube
        for cube in s.cubes:
            assert math.dist((x, y), cube.position[:2]) >= 2 * half_diagonal + AREA.gap_m - 1e-9


def test_the_pick_cost_decides_between_equal_moves(scene):
    s = scene(tower(CUBE, CUBE, CUBE))
    grasps = Grasps()
    for favourite in s.cubes:
        grasps.pick_cost_m = lambda body, f=favourite: float(body is not f)
        move = s.next_move(grasps=grasps)
        assert move.body is favourite


def test_pieces_that_block_a_grasp_are_moved_to_the_ground(scene):
    """The gripper reaches the fourth cube beside a stack of one, not of three or two."""
    s = scene(tower(*[CUBE] * 4))
    for level, cube in enumerate(s.cubes[:3]):
        s.put(cube, 0.45, 0.0, level)
    loose = s.cubes[3]
    s.put(loose, 0.45, 1.1 * B, 0)
    s.world.settle()

    class Blocked(Grasps):
        clears_blocked_pieces = True

        def blocks_grasp(self, body, other, position):
            x, y, z = other.position if position is None else position
            near = math.dist((x, y), body.position[:2]) < 2 * B
            return [near and z - body.position[2] > B / 2]

    assert s.next_move().body is loose
    for top in (s.cubes[2], s.cubes[1]):
        move = s.next_move(grasps=Blocked())
        assert move.body is top
        assert move.onto == ()
        top.place(move.position)
        s.world.settle()
    assert s.next_move(grasps=Blocked()).onto != ()
    # no piece is placed where it would block a grasp
    move = s.next_move(s.cubes[2], Blocked())
    assert move.body is s.cubes[2]
    assert move.onto == (s.cubes[1],)
