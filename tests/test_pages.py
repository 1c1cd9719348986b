"""README and the pages: Python that runs, valid command lines, links with targets."""

import dataclasses
import importlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from ba_torchrl.cli import command_names
from ba_torchrl.cli.command import Command
from ba_torchrl.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
DEMONSTRATIONS = "demos/pulling"
SHORTER = {"agent.learn(10_000)": "agent.learn(120)", "buffer_size=10_000": "buffer_size=200"}
"""Parts of the pages' Python that take minutes, and what runs instead."""


def blocks(page: Path, language: str) -> list[str]:
    fences = re.findall(r"^```(.*)\n((?s:.*?))^```", page.read_text(), re.MULTILINE)
    return [text for info, text in fences if info == language]


def scripts() -> list[tuple[str, str, str]]:
    """Return the name of each script, its source, and the modules that its page shows.

    A block that begins with a docstring is a module, `my_tasks`. One that imports something
    starts a script; one that does not continues it.
    """
    found = []
    for page in PAGES:
        python = blocks(page, "python")
        modules = "".join(block for block in python if block.startswith('"""'))
        for block in python:
            if block.startswith('"""'):
                continue
            if re.match(r"(?s).*^(import|from) ", block, re.MULTILINE):
                found.append([f"{page.name} {len(found)}", "", modules])
            found[-1][1] += block
    return [tuple(script) for script in found]


def command_lines() -> list[tuple[str, str]]:
    found = set()
    for page in PAGES:
        lines = (
            "".join([*blocks(page, ""), *blocks(page, "bash")]).replace("\\\n", " ").splitlines()
        )
        lines += re.findall(r"`(ba-torchrl [^`\n]+)`", page.read_text())
        found |= {(page.name, line.split("  #")[0].strip()) for line in lines}
    return sorted(
        (page, line)
        for page, line in found
        if line.startswith("ba-torchrl ") and not re.search(r"\.\.\.|=NAME|\[my_", line)
    )


@pytest.mark.parametrize(
    ("script", "modules"), [s[1:] for s in scripts()], ids=[s[0] for s in scripts()]
)
def test_python_of_a_page_runs(script, modules, tmp_path):
    for long, short in SHORTER.items():
        script = script.replace(long, short)
    (tmp_path / "script.py").write_text(script)
    (tmp_path / "my_tasks.py").write_text(modules)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    collect = "-m ba_torchrl collect task=close_loop/block_pulling episodes=2 num_envs=1"
    steps = [["script.py"]]
    if DEMONSTRATIONS in script:
        steps.insert(0, f"{collect} parallel=false path={DEMONSTRATIONS}".split())
    for words in steps:
        command = [sys.executable, *words]
        run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("page", "line"), command_lines(), ids=[line for _, line in command_lines()]
)
def test_command_line_of_a_page_is_valid(page, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, *words = shlex.split(line.replace("TASK", "close_loop/block_picking"))[1:]
    if name == "--help" or "--help" in words:
        return
    if not words:  # the name of a command in the text
        assert name in command_names()
        return
    if name in {"evaluate", "report", "export"}:  # the runs that they read
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
        except ConfigError as error:  # names what this machine lacks
            if not re.search("needs a package|no demonstrations at", str(error)):
                raise
        else:
            assert len(reached) == 1


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_links_of_a_page_have_targets(page):
    links = re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)|(?:src|href)=\"([^\"#]+)\"", page.read_text())
    for target in map("".join, links):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), target
