import numpy as np
import pytest

from ba_torchrl.record.plots import Learning, plot_panels
from tests.fresh import run_script

imageio = pytest.importorskip("imageio.v3")

X = np.arange(0, 5000, 500)
BLUE, ORANGE = (0, 114, 178), (213, 94, 0)


def curve(rate, spread=None):
    y = 1 - np.exp(-X / rate)
    return Learning((X, y) if spread is None else (X, y, y - spread, y + spread))


def count(path, color, tolerance=12):
    picture = imageio.imread(path)[..., :3].astype(int)
    return int((np.abs(picture - color).max(-1) <= tolerance).sum())


def shaded(color):
    return tuple(0.2 * part + 0.8 * 255 for part in color)


def test_draws_every_curve_and_its_band_if_it_has_one(tmp_path):
    path = tmp_path / "new" / "curve.png"
    curves = {"equi": curve(600, 0.05), "cnn": curve(2000)}
    plot_panels({"task": curves}, [path], names=list(curves), panel_in=(5, 3.6))
    assert count(path, BLUE) > 500
    assert count(path, ORANGE) > 500
    assert count(path, shaded(BLUE), tolerance=3) > 5000
    assert count(path, shaded(ORANGE), tolerance=3) < 500


def test_plots_leave_no_global_state(tmp_path):
    code = (
        "import sys; from ba_torchrl.record.plots import Learning, plot_panels;"
        "curves = {'a': {'b': Learning(([0, 1], [0, 1]))}};"
        f"plot_panels(curves, [{str(tmp_path / 'curve.png')!r}], names='b');"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    run_script(tmp_path, code)
