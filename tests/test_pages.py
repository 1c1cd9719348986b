"""README and the pages: Python that runs, valid command lines, links with targets."""

import ast
import dataclasses
import importlib
import re
import shlex
import shutil
from pathlib import Path

import pytest

from ba_torchrl.cli import command_names
from ba_torchrl.cli.command import Command
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.observations import vector_names
from tests.fresh import run_script

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += TUTORIALS
TEMPLATES = ROOT / "templates"
DEMONSTRATIONS = "demos/picking"
SHORTER = {
    "agent.learn(10_000)": "agent.learn(102)",
    "n_eval_episodes=20": "n_eval_episodes=1",
    "n_steps=128": "n_steps=102, batch_size=51, n_epochs=1",
    "envs.rollout(100,": "envs.rollout(4,",
    "episodes=500)": "episodes=2)",
    "range(5000)": "range(5)",
    "range(10_000, 10_050)": "range(1)",
    "policy, 100, seed=0)": "policy, 5, seed=0)",
    '"close_loop/block_picking", 5, seed=0)': '"close_loop/block_picking", 1, start_method="fork")',
    '"close_loop/block_picking", 5,': '"close_loop/block_picking", 1,',
    '"mine/stack_on_plateau", 4)': '"mine/stack_on_plateau", 1, start_method="fork")',
}
"""Parts of the pages' Python that take minutes or many processes, and what runs instead."""


def blocks(page: Path, language: str) -> list[str]:
    fences = re.findall(r"^```(.*)\n((?s:.*?))^```", page.read_text(), re.MULTILINE)
    return [text for info, text in fences if info == language]


def scripts(page: Path) -> list[str]:
    """Return the sources of a page's scripts.

    A block that begins with a docstring is a module, `my_tasks`. One that imports something
    starts a script, on the page of a tutorial the first one; others continue it.
    """
    found = []
    for block in blocks(page, "python"):
        if block.startswith('"""'):
            continue
        begins = re.match(r"(?s).*^(import|from) ", block, re.MULTILINE)
        if begins and not (found and page in TUTORIALS):
            found.append("")
        found[-1] += block
    return found


def command_lines(pages: list[Path] = PAGES) -> list[str]:
    found = set()
    for page in pages:
        lines = (
            "".join([*blocks(page, ""), *blocks(page, "bash")]).replace("\\\n", " ").splitlines()
        )
        lines += re.findall(r"`(ba-torchrl [^`\n]+)`", page.read_text())
        found |= {line.split("  #")[0].strip().removeprefix("exec ") for line in lines}
    return sorted(
        line
        for line in found
        if line.startswith("ba-torchrl ") and not re.search(r"\.\.\.|=NAME|\[my_", line)
    )


UNQUOTED = re.compile(r"""(?:^|[ `])(\+?[a-z_.]+=\[(?!["\].]).*)""")
"""A word whose brackets zsh takes as a pattern."""


def unquoted(text: str) -> list[str]:
    return [found[1] for line in text.splitlines() if (found := UNQUOTED.search(line))]


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_brackets_in_a_command_of_a_page_are_quoted(page):
    spans = re.findall(r"`[^`\n]+`", page.read_text())
    assert unquoted("\n".join([*blocks(page, ""), *blocks(page, "bash"), *spans])) == []


def test_brackets_in_a_command_of_a_recipe_or_a_configuration_are_quoted():
    sources = [path.read_text() for path in (ROOT / "recipes").glob("*.py")]
    texts = [ast.get_docstring(ast.parse(text)) for text in sources]
    configs = (path.read_text() for path in (ROOT / "configs").rglob("*.yaml"))
    comments = re.findall(r"#.*", "\n".join(configs))
    assert unquoted("\n".join([*texts, *comments])) == []


def collect(page: Path, folder: Path) -> None:
    """Write two episodes, as the page's `ba-torchrl collect` does."""
    (line,) = (line for line in command_lines([page]) if f" path={DEMONSTRATIONS}" in line)
    words = line.replace(DEMONSTRATIONS, str(folder)).replace("=100", "=2").split()[2:]
    words += ["num_envs=1", "parallel=false"]
    importlib.import_module("ba_torchrl.commands.collect").COMMAND.run(words)


@pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.name) for page in PAGES if scripts(page)]
)
def test_python_of_a_page_runs(page, tmp_path):
    """Its scripts, one after the other in one process."""
    modules = "".join(block for block in blocks(page, "python") if block.startswith('"""'))
    (tmp_path / "my_tasks.py").write_text(modules)
    for path in TEMPLATES.glob("my_*.py"):
        shutil.copy(path, tmp_path)
    names = []
    for number, script in enumerate(scripts(page)):
        for long, short in SHORTER.items():
            script = script.replace(long, short)
        names.append(f"script_{number}.py")
        (tmp_path / names[-1]).write_text(script)
        if DEMONSTRATIONS in script and not (tmp_path / DEMONSTRATIONS).exists():
            collect(page, tmp_path / DEMONSTRATIONS)
    run_script(tmp_path, f"import runpy\nfor n in {names}: runpy.run_path(n, run_name='__main__')")


LINES = command_lines()


@pytest.mark.parametrize("line", LINES)
def test_command_line_of_a_page_is_valid(line, tmp_path, monkeypatch, cached_presets):
    """Apart from the environments and networks of a grid, which a slow test builds."""
    monkeypatch.setattr("ba_torchrl.training.grid.plan._check_parts", lambda runs: None)
    monkeypatch.chdir(tmp_path)
    check_command_line(line)


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in LINES if line.startswith("ba-torchrl bench")])
def test_grid_of_a_page_can_be_built(line, tmp_path, monkeypatch, cached_presets):
    monkeypatch.chdir(tmp_path)
    check_command_line(line)


def check_command_line(line: str) -> None:
    """Check that a command line reaches its work, which is not done."""
    line = line.replace("$SLURM_ARRAY_TASK_ID", "0").replace("TASK", "close_loop/block_picking")
    name, *words = shlex.split(line)[1:]
    if name == "--help" or "--help" in words:
        return
    if not words:  # the name of a command in the text
        assert name in command_names()
        return
    if name in {
        "evaluate",
        "diagnose",
        "report",
        "leaderboard",
        "export",
    }:  # the runs that they read
        for folder in [word for word in words if word.startswith("runs/")]:
            Path(folder).mkdir(parents=True)
    command = importlib.import_module(f"ba_torchrl.commands.{name}").COMMAND
    reached = []

    def main(settings):
        reached.append(settings)

    if isinstance(command, Command):
        main.__module__ = command.main.__module__
        command = dataclasses.replace(command, main=main)
        try:
            Command.run.__wrapped__(command, words)
        except ConfigError as error:  # names what this machine or folder lacks
            if not re.search("needs a package|no demonstrations at|no run in", str(error)):
                raise
        else:
            assert len(reached) == 1


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_links_of_a_page_have_targets(page):
    links = re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)|(?:src|href)=\"([^\"#]+)\"", page.read_text())
    for target in map("".join, links):
        if not target.startswith(("http:", "https:", "generated/")):  # `make docs` checks those
            assert (page.parent / target).exists(), target


def test_the_page_of_environments_names_the_numbers_of_the_pose_vector():
    text = (ROOT / "docs/environments.md").read_text()
    assert re.findall(r"`(opening|(?:tool|object_0)_\w+)`", text) == vector_names(1)
