"""Print what is large: files, classes far below a base, and what one reads for three subjects.

python -m docs.layout

It is advice: a long file may have one subject. The lines to read for a subject are those of all
classes and functions of its folders that are reached by name from an entry: a definition counts
with all of its lines, as do those that it names in its body, its annotations, its decorators and
its bases. Module-level code does not count, nor does what an object's methods do whose class is
named nowhere.
"""

from __future__ import annotations

from docs.sources import PACKAGE, ROOT, Definition, definitions, sources

MOST_LINES, MOST_LEVELS = 400, 2
SETTINGS = Definition(f"{PACKAGE}.core.config", "StrictModel")
"""Base of all settings, as pydantic's `BaseModel`; it is no level."""
SUBJECTS = {
    "close_loop/block_stacking with its expert": (
        Definition(f"{PACKAGE}.tasks.close_loop.block_stacking", "BlockStacking"),
        (f"{PACKAGE}.tasks.",),
    ),
    "SACfD": (
        Definition(f"{PACKAGE}.algorithms.sac", "SAC"),
        (f"{PACKAGE}.algorithms.", f"{PACKAGE}.objectives."),
    ),
    "a training run": (
        Definition(f"{PACKAGE}.commands.train", "main"),
        (f"{PACKAGE}.cli.", f"{PACKAGE}.commands.", f"{PACKAGE}.training.", f"{PACKAGE}.record."),
    ),
}
"""By subject, the entry, and the folders that one reads."""


def to_read(entry: Definition, folders: tuple[str, ...]) -> set[Definition]:
    """Return the definitions of the folders that are reached by name from an entry."""
    found: set[Definition] = set()
    waiting = {entry}
    while waiting:
        found |= waiting
        uses = set().union(*(each.uses for each in waiting))
        waiting = {each for each in uses - found if each.module.startswith(folders)}
    return found


def levels(definition: Definition) -> int:
    """Return the number of levels of inheritance above a class, within the package."""
    bases = definition.bases - {definition, SETTINGS}
    return max((1 + levels(base) for base in bases), default=0)


def main() -> None:
    """Print the lists."""
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
    print("lines to read")
    for subject, (entry, folders) in SUBJECTS.items():
        print(f"  {subject}: {sum(each.lines for each in to_read(entry, folders))}")


if __name__ == "__main__":
    main()
