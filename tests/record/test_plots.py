import subprocess
import sys

import numpy as np
import pytest

from ba_torchrl.record.logging import ScalarLog
from ba_torchrl.record.plots import plot_learning_curve

imageio = pytest.importorskip("imageio.v3")

X = np.arange(0, 5000, 500)
BLUE, ORANGE = (0, 114, 178), (213, 94, 0)


def curve(rate, spread=None):
    y = 1 - np.exp(-X / rate)
    return (X, y) if spread is None else (X, y, y - spread, y + spread)


def count(path, color, tolerance=12):
    picture = imageio.imread(path)[..., :3].astype(int)
    return int((np.abs(picture - color).max(-1) <= tolerance).sum())


def shaded(color):
    return tuple(0.2 * part + 0.8 * 255 for part in color)


def test_draws_every_curve_and_band(tmp_path):
    path = plot_learning_curve(
        {"equi": curve(600, 0.05), "cnn": curve(2000, 0.1)},
        tmp_path / "new" / "curve.png",
        title="close_loop/block_picking",
        ylabel="success rate of the greedy policy",
    )
    assert imageio.imread(path).shape[:2] == (675, 1050)
    for color in (BLUE, ORANGE):
        assert count(path, color) > 500
        assert count(path, shaded(color), tolerance=3) > 5000


def test_a_curve_without_a_band_has_none(tmp_path):
    path = plot_learning_curve({"equi": curve(600)}, tmp_path / "curve.png")
    assert count(path, BLUE) > 500
    assert count(path, shaded(BLUE), tolerance=3) < 500


def test_the_limits_are_those_of_a_rate_by_default(tmp_path):
    flat = {"loss": (X, np.full(len(X), 40.0))}
    rate = plot_learning_curve(flat, tmp_path / "rate.png")
    free = plot_learning_curve(flat, tmp_path / "free.png", ylim=None)
    # Outside the axes only the legend's sample of the line is left.
    assert count(rate, BLUE) < 0.3 * count(free, BLUE)


def test_draws_the_success_rates_of_a_run(tmp_path):
    log = ScalarLog(tmp_path)
    for step in (0, 500, 1000):
        log.write(step, {"eval/success_rate": step / 1000, "train/loss": 3.0})
    log.close()
    of_run = plot_learning_curve(tmp_path / "scalars.csv", tmp_path / "run.png")
    same = {"eval/success_rate": ([0, 500, 1000], [0.0, 0.5, 1.0])}
    expected = plot_learning_curve(same, tmp_path / "same.png")
    np.testing.assert_array_equal(imageio.imread(of_run), imageio.imread(expected))


@pytest.mark.parametrize(
    ("curves", "message"),
    [
        ({}, "no curve"),
        ({"a": (X, X[:-1])}, "'a' is not x, y"),
        ({"a": (X, X, X)}, "'a' is not x, y"),
        ({"a": (X[None], X[None])}, "'a' is not x, y"),
    ],
)
def test_refuses_other_curves(tmp_path, curves, message):
    with pytest.raises(ValueError, match=message):
        plot_learning_curve(curves, tmp_path / "curve.png")


def test_a_missing_package_is_an_error_with_the_fix(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install .*matplotlib"):
        plot_learning_curve({"a": curve(600)}, tmp_path / "curve.png")


def test_plots_leave_no_global_state(tmp_path):
    code = (
        "import sys; from ba_torchrl.record.plots import plot_learning_curve;"
        "assert 'matplotlib' not in sys.modules;"
        f"plot_learning_curve({{'a': ([0, 1], [0, 1])}}, {str(tmp_path / 'curve.png')!r});"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
