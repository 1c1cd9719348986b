"""The scripts and the notebook of docs/tutorials, and the modules that `ba-torchrl new` writes."""

import re
from pathlib import Path

import pytest

from ba_torchrl import cli
from ba_torchrl.cli import data_dir
from docs.notebook import notebook
from tests.fresh import run_script

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
LONG = "STEPS, RANDOM_STEPS, EVERY, EPISODES = 12_000, 500, 1000, 50"
SHORT = "STEPS, RANDOM_STEPS, EVERY, EPISODES = 40, 20, 40, 1"


def script(name):
    text = (FOLDER / f"{name}.py").read_text()
    assert LONG in text
    return text.replace(LONG, SHORT)


def test_the_script_of_sac_trains_from_images(tmp_path):
    code = script("sac").replace('"images" in sys.argv[1:]', "True")
    out = run_script(tmp_path, code).stdout
    assert re.search(r"40 steps, \d\.\d minutes of CPU time: success rate ", out)
    assert "test: success rate " in out


def test_the_notebook_of_sac_is_one():
    nbformat = pytest.importorskip("nbformat")
    found = nbformat.from_dict(notebook(script("sac")))
    nbformat.validate(found)
    assert [cell.cell_type for cell in found.cells[:2]] == ["markdown", "code"]


@pytest.mark.slow
def test_the_notebook_of_sac_trains_from_poses():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    found = nbformat.from_dict(notebook(script("sac")))
    nbclient.NotebookClient(found, timeout=240, kernel_name="python3").execute()
    assert "test: success rate " in found.cells[-1].outputs[-1].text


def test_what_the_command_writes_passes_its_own_test(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    commands, tests = [], []
    for kind, name in (("task", "push_far"), ("algorithm", "far_sac"), ("network", "far_net")):
        cli.main(["new", kind, name])
        lines = capsys.readouterr().out.splitlines()
        tests.append(f"test_{name}.py")
        assert lines[:2] == [
            f"{name}.py and {tests[-1]} are written. Next:",
            f"  python -m pytest {tests[-1]}",
        ]
        text = Path(f"{name}.py").read_text() + Path(tests[-1]).read_text()
        assert f'.register("mine/{name}")' in text
        assert "my_" not in text.lower()
        commands += [line for line in lines[2:] if line.startswith("  ba-torchrl ")]
    code = (
        "import pytest\nfrom tests.test_pages import check_command_line\n"
        f"for line in {commands}:\n    check_command_line(line)\n"
        f"raise SystemExit(pytest.main(['-q', *{tests}]))\n"
    )
    assert re.search("^6 passed", run_script(tmp_path, code).stdout, re.MULTILINE)


@pytest.mark.parametrize("kind", ["task", "algorithm", "network"])
def test_the_name_that_the_tutorial_gives_is_free(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["new", kind, f"my_{kind}"])
    for file in (f"my_{kind}.py", f"test_my_{kind}.py"):
        assert Path(file).read_text() == (data_dir("templates") / file).read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["task", "mine"], "mine.py exists already"),
        (["task", "json"], "another module has the name 'json'"),
        (["task", "a-b"], "'a-b' is no name of a module"),
        (["task", "_1"], "'_1' gives no name to its class"),
        (["task", "box"], "imports another Box"),
        (["tasks", "a"], "kind: must be 'task', 'algorithm' or 'network'"),
        (["task"], "name is missing"),
        (["task", "a", "b"], "'b' sets nothing"),
        (["task", "kind=network"], "kind is given twice"),
    ],
)
def test_the_command_refuses(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("x = 1\n")
    with pytest.raises(SystemExit):
        cli.main(["new", *words])
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]
    assert Path("mine.py").read_text() == "x = 1\n"
