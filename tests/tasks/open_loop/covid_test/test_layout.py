"""The initial scene: sizes, layouts of the areas, poses of tubes and swabs."""

import math

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.bodies import vertical_extent
from ba_torchrl.tasks.open_loop.covid_test import NEW_BOX, SHEET_M, TEST_AREA, USED_BOX, WALL_M
from tests.tasks.open_loop.covid_test.scenes import FIXED, TASK, local, outline


def test_sizes_are_the_papers(make):
    task = make().scene.task
    for bodies, size in ((task.tubes, (0.08, 0.017, 0.017)), (task.swabs, (0.07, 0.01, 0.01))):
        assert [body.shape.size_m for body in bodies] == [pytest.approx(size)] * 3
    assert make().max_steps == 30


def test_layouts_are_random_adjacent_and_inside_the_workspace(make):
    env = make()
    yaws, sides, centers = [], [], []
    for _ in range(60):
        env.reset()
        task = env.scene.task
        layout = task.layout
        areas = (
            (layout.new_box, NEW_BOX),
            (layout.used_box, USED_BOX),
            (layout.test_area, TEST_AREA),
        )
        corners = {area: outline(task, area, spec.size) for area, spec in areas}
        for points in corners.values():
            assert (points >= (0.25 - 1e-9, -0.2 - 1e-9)).all()
            assert (points <= (0.65 + 1e-9, 0.2 + 1e-9)).all()
        for one, other in ((layout.new_box, layout.used_box), (layout.new_box, layout.test_area)):
            near = np.linalg.norm(corners[one][:, None] - corners[other][None], axis=-1).min()
            assert near < 0.06
        assert len({area.yaw_rad for area, _ in areas}) == 1
        yaws.append(task.layout.new_box.yaw_rad)
        centers.append(task.layout.test_area.position[:2])
        x, _ = local(task.layout.new_box, task.layout.test_area.position)
        assert abs(x) == pytest.approx(0.1525, abs=1e-6)
        sides.append(x > 0)
    quarters = np.round(np.array(yaws) / (math.pi / 2)).astype(int) % 4
    assert set(quarters) == {0, 1, 2, 3}
    off = np.degrees((np.array(yaws) + math.pi / 4) % (math.pi / 2) - math.pi / 4)
    assert 15 < np.abs(off).max() <= 18.5
    assert {True, False} == set(sides)  # mirrored or not
    assert np.ptp(centers, axis=0).min() > 0.15


def test_tubes_and_swabs_start_apart_on_the_floor_of_their_box(make):
    env = make()
    for _ in range(20):
        env.reset()
        task = env.scene.task
        assert len(task.objects) == 6
        for body in task.objects:
            x, y = local(task.layout.new_box, body.position)
            assert abs(x) < NEW_BOX.size[0] / 2 - WALL_M
            assert abs(y) < NEW_BOX.size[1] / 2 - WALL_M
            assert vertical_extent(body)[0] == pytest.approx(SHEET_M, abs=3e-4)
            assert body.tilt_rad < 0.01
            others = [other for other in task.objects if other is not body]
            assert min(math.dist(body.position, other.position) for other in others) > 0.045


def test_fixed_orientations_lie_along_y(make):
    env = make(**FIXED)
    yaws = set()
    for _ in range(12):
        env.reset()
        task = env.scene.task
        yaws.add(round(abs(task.layout.new_box.yaw_rad), 6))
        for body in task.objects:
            assert body.yaw_rad == pytest.approx(math.pi / 2, abs=1e-2)
    assert yaws == {0.0, round(math.pi, 6)}


def test_objects_that_do_not_fit_their_box_are_refused():
    with pytest.raises(ConfigError, match="object_scale_range"):
        ba_torchrl.make(TASK, object_scale_range=0.8)
