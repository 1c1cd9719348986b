"""Draw the folders of the package and their imports into architecture.md.

python docs/architecture.py

An arrow leads from a folder to one that it imports. Imports that follow from other arrows are left
out, so that the picture shows the direction and not every line.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "ba_torchrl"
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- imports: begin -->\n", "<!-- imports: end -->\n"

BASE = (
    "errors",
    "config",
    "registry",
    "plugins",
    "actions",
    "hardware",
    "_malloc",
    "_segment_tree",
    "_jit",
)
"""Single files; one box in the picture."""


def part_of(names: list[str]) -> str:
    """Return the box of a module, given the parts of its dotted name below the package."""
    if not names:
        return "make"
    return "base" if names[0] in BASE else names[0]


def imports() -> dict[str, set[str]]:
    """Return the boxes that each box imports directly."""
    found: dict[str, set[str]] = {}
    for path in sorted([*(ROOT / PACKAGE).rglob("*.py"), *(ROOT / "recipes").glob("*.py")]):
        names = list(path.relative_to(ROOT).with_suffix("").parts)
        if names[-1] == "__init__":
            names.pop()
        part = "recipes" if names[0] == "recipes" else part_of(names[1:])
        targets = found.setdefault(part, set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                modules = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                continue
            for module in modules:
                root, *below = module.split(".")
                if root == PACKAGE:
                    is_part = below and (
                        (ROOT / PACKAGE / below[0]).is_dir()
                        or (ROOT / PACKAGE / f"{below[0]}.py").exists()
                    )
                    targets.add(part_of(below if is_part else []))
    return {part: targets - {part} for part, targets in found.items()}


def reduced(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the edges that do not follow from longer paths; the graph has no circle."""
    reach: dict[str, set[str]] = {}

    def below(part: str) -> set[str]:
        if part not in reach:
            reach[part] = set().union(*({t} | below(t) for t in graph.get(part, ())))
        return reach[part]

    return {
        part: {t for t in targets if not any(t in below(other) for other in targets - {t})}
        for part, targets in graph.items()
    }


def mermaid() -> str:
    """Return the picture as a Mermaid flowchart."""
    graph = imports()
    # `make` builds environments, which import nothing of it: the functions import when called
    graph["make"] = graph.get("make", set()) | {"envs"}
    lines = ["```mermaid", "flowchart TB"]
    labels = {
        "base": "errors, config, registry,\\nplugins, actions",
        "make": "ba_torchrl.make",
    }
    for part in sorted(graph):
        lines.append(f'    {part}["{labels.get(part, part + "/")}"]')
    for part, targets in sorted(reduced(graph).items()):
        lines += [f"    {part} --> {target}" for target in sorted(targets)]
    return "\n".join([*lines, "```", ""])


def page_with_picture(page: str) -> str:
    """Return a page with the picture of the present imports between its markers."""
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    return before + BEGIN + mermaid() + END + after


if __name__ == "__main__":
    PAGE.write_text(page_with_picture(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
