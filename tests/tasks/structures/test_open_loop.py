"""Open-loop structures: conditions of success, random shapes, experts."""

import math

import pytest

from ba_torchrl.tasks.structures.pick_place_expert import PickPlaceExpert
from ba_torchrl.tasks.structures.planner import next_move
from tests.tasks.episodes import follow

B = 0.03
X, Y = 0.45, 0.0
APART = 1.75 * B / 2
HOUSES = ["block_stacking", *(f"house_building_{i}" for i in (1, 2, 3, 4))]
IMPROVISED = ["improvise_house_building_2", "improvise_house_building_3"]


class House:
    """A task with its structure standing, in which tests move pieces."""

    def __init__(self, env, name):
        self.task, self.world = env.scene.task, env.scene.world
        self.named = {body.name: body for body in self.task.objects}
        self.cubes = [body for name, body in self.named.items() if name.startswith("cube")]
        self.build(name)

    def build(self, name):
        if name in ("block_stacking", "house_building_1"):
            for level, cube in enumerate(self.cubes):
                self.put(cube, 0.0, level)
            if "triangle 1" in self.named:
                self.put(self.named["triangle 1"], 0.0, len(self.cubes))
        else:
            for side, cube in zip((-APART, APART), self.cubes[:2], strict=True):
                self.put(cube, side, 0)
            level = 1
            if "cuboid 1" in self.named:
                self.put(self.named["cuboid 1"], 0.0, level)
                level += 1
            if len(self.cubes) == 4:
                for side, cube in zip((-APART, APART), self.cubes[2:], strict=True):
                    self.put(cube, side, level)
                level += 1
            self.put(self.named["roof 1"], 0.0, level)
        self.world.settle()

    def put(self, body, along, level, across=0.0):
        body.place((X + across, Y + along, (level + 0.5) * B))

    @property
    def top(self):
        return max(self.task.objects, key=lambda body: body.position[2])

    def is_success(self):
        self.world.step(2)
        self.world.settle()
        return self.task.is_success()


@pytest.fixture
def house(make_started):
    return lambda name: House(make_started(f"open_loop/{name}"), name)


@pytest.mark.parametrize("name", HOUSES)
def test_the_finished_structure_is_the_goal_and_a_tipped_roof_ends_the_episode(house, name):
    h = house(name)
    assert h.is_success()
    assert h.task.is_valid()
    top = h.top
    top.place((X + 0.12, Y, -top.shape.bounds_m[0][2]))
    assert not h.is_success()
    assert h.task.is_valid()
    turn = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))
    top.set_pose((X + 0.13, Y, 0.02), turn)
    assert not h.is_success()
    assert h.task.is_valid() == (name == "block_stacking")


@pytest.mark.parametrize("name", ["house_building_2", "house_building_3", "house_building_4"])
def test_a_roof_on_one_support_or_off_the_centre_is_not_a_success(house, name):
    h = house(name)
    roof = h.named["roof 1"]
    x, y, z = roof.position
    if name == "house_building_3":
        cuboid = h.named["cuboid 1"]
        cuboid.place((x, y + 0.8 * B, cuboid.position[2]))
        roof.place((x, y + 1.2 * B, z))  # on the cuboid, off the centre of the cubes
    else:
        other = h.cubes[-1]
        side = math.copysign(1.0, other.position[1] - Y)
        other.place((X, Y + side * 0.14, B / 2))
        roof.place((x, y - side * APART, z))
    assert not h.is_success()
    assert roof.tilt_rad < 0.1
    assert roof.position[2] == pytest.approx(z, abs=2e-3)


@pytest.mark.parametrize("name", ["house_building_3", "house_building_4"])
def test_a_house_without_a_storey_is_not_a_success(house, name):
    h = house(name)
    roof, cuboid = h.named["roof 1"], h.named["cuboid 1"]
    for cube in h.cubes[2:]:
        cube.place((X + 0.1 * (1 if cube is h.cubes[2] else -1), Y, B / 2))
    cuboid.place((X + 0.15, Y, B / 2))
    h.put(roof, 0.0, 1)
    assert not h.is_success()


# -- improvised houses -------------------------------------------------------------------------


@pytest.mark.parametrize("name", IMPROVISED)
def test_every_episode_draws_its_shapes(make_started, name):
    env = make_started(f"open_loop/{name}")
    drawn = set()
    for _ in range(12):
        env.reset()
        task = env.scene.task
        visible = {body for body in env.scene.world.bodies if not body.is_hidden}
        assert visible == set(task.objects)
        assert len(task.objects) == task.num_objects
        drawn.add(tuple(body.name for body in task.objects[1:3]))
    assert len(drawn) > 8


# -- experts -----------------------------------------------------------------------------------


def test_either_of_the_two_shapes_can_be_picked_first(make_env):
    env = make_env("open_loop/improvise_house_building_3")
    state = env.reset()
    moves = state["expert_moves"].unique(dim=0)
    shapes = [body.position[:2] for body in env.scene.task.objects if "object" in body.name]
    nearest = [min(math.dist(move, xy) for move in moves[:, 1:3].tolist()) for xy in shapes]
    assert len(moves) == len(shapes) == 2
    assert max(nearest) < B / 2
    other = moves[(moves != state["expert_action"]).any(dim=1)]
    (after,) = follow(env, state, 1, action=other[0])
    assert after["holding"]


def test_the_structure_starts_at_a_site_where_other_picks_have_clearance(make_started):
    """A roof lies close to one pair of blocks; the structure starts at the other pair."""
    env = make_started("open_loop/house_building_4")
    task, world = env.scene.task, env.scene.world
    named = {body.name: body for body in task.objects}
    points = [(0.40, -0.12), (0.40, -0.04), (0.36, 0.15), (0.55, 0.15)]
    for number, (x, y) in enumerate(points, start=1):
        named[f"cube {number}"].place((x, y, B / 2))
    named["roof 1"].place((0.47, -0.08, B / 2))
    named["cuboid 1"].place((0.56, -0.08, B / 2))
    world.step(2)
    pick = task.expert_command()
    grasps = task.grasps()
    area = PickPlaceExpert(grasps).placement_area()
    move = next_move(task.structure.assigner(None), area, grasps)
    assert math.dist(move.position[:2], (0.47, -0.08)) > 0.1
    assert (pick.x_m, pick.y_m) == pytest.approx(move.body.position[:2])
