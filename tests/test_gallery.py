import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image, ImageDraw

from recipes.gallery import (
    MOST_FRAMES,
    Strip,
    expert_strip,
    labelled,
    overview_of,
    write,
    write_film,
)

TASK = "close_loop/block_reaching"
BLUE = (20, 40, 220)


@pytest.fixture
def texts(monkeypatch):
    """The texts of the pictures."""
    found = []
    draw = ImageDraw.ImageDraw.text

    def recording(self, position, text, *args, **options):
        found.append(text)
        draw(self, position, text, *args, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", recording)
    return found


def plain_strip(count=2):
    picture = np.full((40, 40, 3), BLUE, dtype=np.uint8)
    return Strip([picture] * count, np.zeros((20, 20)))


def blue_areas(path):
    """Return the (row, column, height, width) of each blue area of a picture."""
    picture = imageio.imread(path)[..., :3].astype(int)
    blue = (np.abs(picture - BLUE) < 30).all(-1)
    edges = np.diff(blue.any(1).astype(int), prepend=0, append=0)
    areas = []
    for top, bottom in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        sides = np.diff(blue[top:bottom].any(0).astype(int), prepend=0, append=0)
        lefts, rights = np.flatnonzero(sides == 1), np.flatnonzero(sides == -1)
        areas += [
            (top, left, bottom - top, right - left)
            for left, right in zip(lefts, rights, strict=True)
        ]
    return areas


def test_a_strip_runs_from_the_first_scene_to_the_goal(tmp_path):
    strip = expert_strip(TASK, seed=0, pictures=3)
    assert len(strip.pictures) == 3
    assert not np.array_equal(strip.pictures[0], strip.pictures[-1])
    assert strip.first_image.shape == (128, 128)
    row = labelled(TASK, [strip.first_image, *strip.pictures])
    picture = imageio.imread(write(row, tmp_path / "new" / "strip.png"))
    assert picture.shape[1] > 3 * picture.shape[0]
    assert picture.std() > 10


def test_an_open_loop_strip_shows_a_grasp_and_repeats_no_image():
    strip = expert_strip("open_loop/object_grasping", seed=0, pictures=4)
    start, grasp, goal = strip.pictures
    orange = [
        ((image[..., 0] > 150) & (image[..., 1] < 110) & (image[..., 2] < 60))[:120].sum()
        for image in (start, grasp, goal)
    ]  # the wrist, which is in the image only at a grasp
    assert orange[1] > orange[0] + 300
    assert orange[1] > orange[2] + 300


def test_a_deconstruction_starts_from_the_goal():
    task = "open_loop/house_building_2"
    built = expert_strip(task, seed=0, pictures=2)
    apart = expert_strip(task, seed=0, pictures=2, deconstruct=True)
    assert built.first_image.max() < 0.6 * apart.first_image.max()


def test_a_long_film_has_fewer_images_and_ends_with_the_last(tmp_path):
    frames = [
        np.full((16, 16, 3), value, np.uint8) for value in [*(37 * i % 256 for i in range(99)), 255]
    ]
    with Image.open(write_film(frames, 50, tmp_path / "film.webp")) as film:
        assert MOST_FRAMES / 2 < film.n_frames <= MOST_FRAMES
        film.seek(film.n_frames - 1)
        assert np.asarray(film.convert("RGB")).min() > 245


def test_a_film_that_is_too_large_has_a_lower_quality(tmp_path, monkeypatch):
    frames = list(np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8))
    large = write_film(frames, 50, tmp_path / "large.webp").stat().st_size
    monkeypatch.setattr("recipes.gallery.MOST_BYTES", large - 1)
    assert write_film(frames, 50, tmp_path / "small.webp").stat().st_size < large


def test_an_overview_has_start_and_goal_of_each_task_under_headings(tmp_path, texts, monkeypatch):
    tasks = [f"close_loop/task_{i}" for i in range(3)] + ["ramp/house", "bump/house"]
    monkeypatch.setattr("recipes.gallery.COLUMNS", 2)
    path = write(overview_of(dict.fromkeys(tasks, plain_strip())), tmp_path / "all.png")
    areas = blue_areas(path)
    assert len(areas) == 2 * len(tasks)
    assert len({top for top, *_ in areas}) == 3  # two rows of close loop, one of ramps and bumps
    assert len({size for area in areas for size in area[2:]}) == 1  # square
    assert texts == [
        "Close loop",
        "task 0",
        "task 1",
        "task 2",
        "Six degrees of freedom: ramps, bumps",
        "ramp: house",
        "bump: house",
    ]
