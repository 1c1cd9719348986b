"""Files of measured rows: written, read, compared; only documented errors."""

import json

import numpy as np
import pytest
import torch

from ba_torchrl.core.errors import ConfigError
from profiling.comparison import changes, columns_of_changes, ratio_of_medians
from profiling.speed_file import (
    Machine,
    SpeedFile,
    read_speed_file,
    write_speed_file,
)
from profiling.table import COLUMNS, Budget, Row, as_markdown
from tests.recipes import recipe

ROWS = [
    Row("update", "s", [1.5, 1.25, 2.0], Budget("13.5", 2.0, None), [0.5, 0.25], [0.125], "a note"),
    Row("replay", "MB", [38.8]),
]


@pytest.fixture
def content():
    return SpeedFile(machine=Machine.here(torch.device("cpu")), rows=ROWS)


def test_a_file_holds_all_values_machine_versions_date_and_commit(tmp_path, content):
    path = write_speed_file(tmp_path / "speed.json", content)
    assert read_speed_file(path) == content
    values = json.loads(path.read_text())
    assert values["rows"][0]["values"] == [1.5, 1.25, 2.0]
    assert values["rows"][0]["unit_s"] == [0.5, 0.25]
    assert values["machine"]["versions"]["torch"] == torch.__version__
    assert values["machine"]["threads"] == torch.get_num_threads()


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda values: [1], "content: "),
        (lambda values: {**values, "format": 2}, "format: "),
        (lambda values: {**values, "machine": {}}, "machine.cpu: "),
        (lambda values: {**values, "rows": [{**values["rows"][0], "values": []}]}, "rows.0.values"),
        (lambda values: {**values, "rows": [{**values["rows"][0], "values": [0.0]}]}, "greater"),
        (lambda values: {**values, "rows": [{**values["rows"][0], "unit": "h"}]}, "rows.0.unit"),
        (lambda values: {**values, "rows": [{**values["rows"][0], "new": 1}]}, "rows.0.new"),
    ],
)
def test_a_foreign_file_is_refused_in_one_line(damage, reason, tmp_path, content):
    path = write_speed_file(tmp_path / "speed.json", content)
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(ConfigError, match=reason) as raised:
        read_speed_file(path)
    assert str(raised.value).startswith(f"{path} is not a file that recipes/measure.py wrote (")
    assert "\n" not in str(raised.value)


def test_the_recipe_writes_a_file_and_compares_with_it(monkeypatch, tmp_path, content, capsys):
    monkeypatch.chdir(tmp_path)
    old = Row("depth image, 128 px, compiled", "ms", [1e3] * 20, unit_s=[1e-3] * 20)
    write_speed_file(tmp_path / "old.json", SpeedFile(machine=content.machine, rows=[old]))
    recipe(
        "measure",
        "which=simulation/depth_image",
        "repeats=1",
        "compare=old.json",
        "output=new/speed.json",
    )
    header, _, *rows, empty, where, other = capsys.readouterr().out.strip().split("\n")
    assert (empty, other) == ("", f"old: {content.machine}, precision auto")
    cells = [
        dict(
            zip(
                *([cell.strip() for cell in line.split("|")[1:-1]] for line in (header, row)),
                strict=True,
            )
        )
        for row in rows
    ]
    assert cells[0]["work"] == old.work
    assert cells[0]["old median"] == "1000"
    assert cells[0]["difference"] == "above noise"
    assert float(cells[0]["new / old"].split()[0]) < 0.1
    assert cells[1]["old median"] == cells[1]["difference"] == ""
    new = read_speed_file(tmp_path / "new" / "speed.json")
    assert f"{new.machine}, precision {new.precision}" == where
    assert [row.work for row in new.rows] == [row["work"] for row in cells]
    assert len(new.rows[0].values) == len(new.rows[0].unit_s) == 10


# -- noise -----------------------------------------------------------------------------------------


def samples(median, count, rng):
    """Times with a long upper tail, as a busy machine has."""
    return (median * (1 + rng.exponential(0.1, count))).tolist()


def test_equal_samples_are_within_the_noise_and_different_ones_above_it():
    rng = np.random.default_rng(0)
    ratios = [
        ratio_of_medians([samples(1.0, 20, rng)], [samples(1.0, 20, rng)]) for _ in range(100)
    ]
    assert sum(ratio.is_above_noise for ratio in ratios) <= 9  # 95 % interval
    ratios = [ratio_of_medians([samples(1.2, 20, rng)], [samples(1.0, 20, rng)]) for _ in range(50)]
    assert sum(ratio.is_above_noise for ratio in ratios) >= 45
    assert np.median([ratio.value for ratio in ratios]) == pytest.approx(1.2, rel=0.02)


def test_values_that_depend_on_the_one_before_have_a_wider_interval():
    rng = np.random.default_rng(0)
    drawn = [np.repeat(samples(1.0, 20, rng), 10).tolist() for _ in range(200)]
    ratios = [
        ratio_of_medians([new], [old]) for new, old in zip(drawn[::2], drawn[1::2], strict=True)
    ]
    assert sum(ratio.is_above_noise for ratio in ratios) <= 9


def test_few_values_have_no_interval():
    ratio = ratio_of_medians([[1.0] * 5], [[2.0] * 20])
    assert (ratio.value, ratio.interval, ratio.is_above_noise) == (0.5, None, None)
    assert ratio_of_medians([[1.0] * 6], [[2.0] * 6]).interval == (0.5, 0.5)
    assert ratio_of_medians([[1.0] * 6], [[2.0] * 47]).interval == (0.5, 0.5)


@pytest.mark.parametrize(("unit", "values"), [("ms", (10.0, 20.0)), ("frames/s", (10.0, 5.0))])
def test_units_cancel_the_speed_of_the_machine(unit, values):
    """All durations on the new machine are twice as long, also that of the unit of work."""
    old, new = (
        Row("work", unit, [value] * 8, unit_s=[unit_s] * 8)
        for value, unit_s in zip(values, (1.0, 2.0), strict=True)
    )
    of_values, of_units = changes(old, new)
    assert (of_values.value, of_units.value) == (values[1] / values[0], 1.0)
    assert (of_values.is_above_noise, of_units.is_above_noise) == (True, False)
    assert columns_of_changes([old], [new])["difference"](new) == "within noise"


def test_rows_are_compared_with_those_of_the_same_work_and_unit():
    old = [Row("a", "ms", [1.0] * 8), Row("b", "ms", [1.0] * 8), Row("c", "s", [1.0] * 8)]
    new = [Row("a", "ms", [3.0] * 8), Row("b", "s", [1.0] * 8), Row("d", "s", [1.0] * 8)]
    columns = {"work": COLUMNS["work"], **columns_of_changes(old, new)}
    lines = as_markdown(new, columns).splitlines()
    assert lines[0] == "| work | old median | new / old | new / old, units | difference |"
    assert lines[2] == "| a | 1 | 3 (3 to 3) |  | above noise |"
    assert lines[3:] == ["| b |  |  |  |  |", "| d |  |  |  |  |"]
