"""Draw the folders of the package and their imports into architecture.md.

python -m docs.architecture

An arrow leads from a folder to one that it imports. Imports that follow from other arrows are left
out, so that the picture shows the direction and not every line.
"""

from __future__ import annotations

from docs.sources import PACKAGE, ROOT, imports, sources

PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- imports: begin -->\n", "<!-- imports: end -->\n"
SPACING = '%%{init: {"flowchart": {"nodeSpacing": 12, "rankSpacing": 30, "padding": 8}}}%%'
"""Of boxes, so that names are readable on a telephone."""


def part_of(names: list[str]) -> str:
    """Return the box of a module, given the parts of its dotted name below the package."""
    return names[0] if names else "make"


def graph() -> dict[str, set[str]]:
    """Return the boxes that each box imports directly."""
    found: dict[str, set[str]] = {}
    for module in sources():
        root, *below = module.split(".")
        targets = found.setdefault(part_of(below) if root == PACKAGE else root, set())
        for dotted in imports(module).values():
            root, *below = dotted.split(".")
            if root == PACKAGE:
                is_part = bool(below) and f"{PACKAGE}.{below[0]}" in sources()
                targets.add(part_of(below if is_part else []))
    return {part: targets - {part} for part, targets in found.items()}


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the edges that do not follow from longer paths; they have no circle."""
    reach: dict[str, set[str]] = {}

    def below(part: str) -> set[str]:
        if part not in reach:
            reach[part] = set().union(*({t} | below(t) for t in edges.get(part, ())))
        return reach[part]

    return {
        part: {t for t in targets if not any(t in below(other) for other in targets - {t})}
        for part, targets in edges.items()
    }


def mermaid() -> str:
    """Return the picture as a Mermaid flowchart."""
    edges = graph()
    # `make` builds environments, which import nothing of it: the functions import when called
    edges["make"] = {"envs"}
    lines = ["```mermaid", SPACING, "flowchart TB"]
    for part in sorted(edges):
        label = "ba_torchrl.make" if part == "make" else f"{part}/"
        lines.append(f'    {part}["{label}"]')
    for part, targets in sorted(reduced(edges).items()):
        lines += [f"    {part} --> {target}" for target in sorted(targets)]
    return "\n".join([*lines, "```", ""])


def page_with_picture(page: str) -> str:
    """Return a page with the picture of the present imports between its markers."""
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    return before + BEGIN + mermaid() + END + after


if __name__ == "__main__":
    PAGE.write_text(page_with_picture(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
