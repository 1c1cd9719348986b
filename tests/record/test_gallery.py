import imageio.v3 as imageio
import numpy as np

from ba_torchrl.record.gallery import expert_strip, overview_figure, strip_figure

TASK = "close_loop/block_reaching"


def test_a_strip_runs_from_the_first_scene_to_the_goal(tmp_path):
    strip = expert_strip(TASK, seed=0, pictures=3)
    assert len(strip.pictures) == 3
    assert not np.array_equal(strip.pictures[0], strip.pictures[-1])
    assert strip.first_image.shape == (128, 128)
    picture = imageio.imread(strip_figure(TASK, strip, tmp_path / "new" / "strip.png"))
    assert picture.shape[1] > 3 * picture.shape[0]
    assert picture.std() > 10


def test_a_deconstruction_starts_from_the_goal():
    task = "open_loop/house_building_2"
    built = expert_strip(task, seed=0, pictures=2)
    apart = expert_strip(task, seed=0, pictures=2, deconstruct=True)
    assert built.first_image.max() < 0.6 * apart.first_image.max()


def test_an_overview_has_a_cell_for_each_task(tmp_path):
    strip = expert_strip(TASK, seed=0, pictures=1)
    path = overview_figure({str(i): strip for i in range(5)}, tmp_path / "all.png", columns=4)
    picture = imageio.imread(path)[..., :3]
    rows, columns = picture.shape[0] // 2, picture.shape[1] // 4
    filled = [
        picture[i * rows : (i + 1) * rows, j * columns : (j + 1) * columns].std() > 10
        for i in range(2)
        for j in range(4)
    ]
    assert filled == [True] * 5 + [False] * 3
