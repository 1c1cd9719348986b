"""Print what is large: files, classes far below a base, what one reads for six subjects; and the
private names of other libraries that are used.

python -m docs.layout

It is advice: a long file may have one subject. To read for a subject are the files of its folders,
as a whole, with the classes and functions that are reached by name from its entry, in the order in
which a reader meets them. A definition reaches those that it names in its body, its annotations,
its decorators and its bases; module-level code reaches nothing.
"""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path
from typing import NamedTuple

from docs.private_names import OTHERS, REASONS
from docs.sources import PACKAGE, ROOT, Definition, definitions, file_of, sources

MOST_LINES, MOST_LEVELS = 400, 2
SETTINGS = Definition(f"{PACKAGE}.core.config", "StrictModel")
"""Base of all settings, as pydantic's `BaseModel`; it is no level."""
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class Subject(NamedTuple):
    """What one reads: from which definitions on, in which folders, and in how many lines."""

    title: str
    entries: tuple[str, ...]
    folders: tuple[str, ...]
    aim: int | None = None


SUBJECTS = (
    Subject(
        "close_loop/block_stacking with its expert",
        ("tasks.close_loop.block_stacking.BlockStacking",),
        ("tasks",),
        2100,
    ),
    Subject(
        "open_loop/block_stacking with its expert",
        ("tasks.open_loop.block_stacking.BlockStacking",),
        ("tasks",),
    ),
    Subject("SACfD", ("algorithms.sac.SAC",), ("algorithms", "objectives"), 2000),
    Subject(
        "SDQfD with Equi ASR",
        ("algorithms.spatial_q.SpatialQ", "modules.spatial.equi_asr.build_equi_asr"),
        ("algorithms", "objectives", "modules.spatial"),
        2600,
    ),
    Subject("a training run", ("commands.train.main",), ("commands", "training"), 1700),
    Subject("a step of an environment", ("envs.factory.make",), ("envs",), 1900),
)


def to_read(subject: Subject) -> list[str]:
    """Return the modules of a subject in the order in which they are opened."""
    folders = tuple(f"{PACKAGE}.{folder}." for folder in subject.folders)
    waiting = [Definition(*f"{PACKAGE}.{name}".rsplit(".", 1)) for name in subject.entries]
    for definition in waiting:
        new = (each for each in definition.names if each.module.startswith(folders))
        waiting += [each for each in dict.fromkeys(new) if each not in waiting]
    return list(dict.fromkeys(each.module for each in waiting))


def length(module: str) -> int:
    """Return the number of lines of a module."""
    return len(file_of(module).read_text(encoding="utf-8").splitlines())


def code_lines(path: Path) -> int:
    """Return the number of lines of a file that have code: no docstrings, comments or blanks."""
    text = path.read_text(encoding="utf-8")
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                lines.difference_update(range(child.lineno, child.end_lineno + 1))
    return len(lines)


def levels(definition: Definition) -> int:
    """Return the number of levels of inheritance above a class, within the package."""
    bases = definition.bases - {definition, SETTINGS}
    return max((1 + levels(base) for base in bases), default=0)


def main() -> None:
    """Print the lists."""
    print("lines, and those with code")
    command_line = (f"{PACKAGE}/cli", f"{PACKAGE}/commands")
    for folder in (PACKAGE, *command_line, "recipes", "docs", "tests"):
        paths = [path for path in (ROOT / folder).rglob("*.py") if path.is_file()]
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)
        print(f"  {folder}: {lines}, {sum(map(code_lines, paths))}")
    print(f"files over {MOST_LINES} lines")
    for folder in (PACKAGE, "recipes", "tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            lines = len(path.read_text(encoding="utf-8").splitlines())
            if lines > MOST_LINES:
                print(f"  {path.relative_to(ROOT)}: {lines}")
    print(f"classes more than {MOST_LEVELS} levels below a base")
    for module in sources():
        for name in definitions(module):
            if levels(Definition(module, name)) > MOST_LEVELS:
                print(f"  {module}.{name}: {levels(Definition(module, name))}")
    for owner, reasons in (("torch and TorchRL", REASONS), ("other libraries", OTHERS)):
        print(f"private names of {owner}: {len(reasons)}")
        for name, reason in reasons.items():
            print(f"  {name}: {reason}")
    print("files to read")
    for subject in SUBJECTS:
        modules = to_read(subject)
        aim = f", aim {subject.aim}" if subject.aim else ""
        code = sum(code_lines(file_of(module)) for module in modules)
        lines = f"{sum(map(length, modules))} lines, {code} of code"
        print(f"  {subject.title}: {lines}, in {len(modules)} files{aim}")
        for module in modules:
            print(f"    {length(module):4} {file_of(module).relative_to(ROOT / PACKAGE)}")


if __name__ == "__main__":
    main()
