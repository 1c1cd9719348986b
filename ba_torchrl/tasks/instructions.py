"""Words and phrases of the instructions, the sentences that state the goal of an episode."""

from __future__ import annotations

from collections.abc import Sequence

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.shapes import Color
from ba_torchrl.tasks.structures.blueprint import Blueprint

COLOR_NAMES: dict[str, tuple[float, float, float]] = {
    "red": (0.85, 0.2, 0.2),
    "orange": (0.9, 0.55, 0.15),
    "yellow": (0.95, 0.85, 0.25),
    "green": (0.3, 0.65, 0.35),
    "blue": (0.2, 0.4, 0.8),
    "light blue": (0.35, 0.7, 0.8),
    "purple": (0.6, 0.4, 0.75),
    "pink": (0.8, 0.45, 0.6),
    "brown": (0.6, 0.45, 0.3),
    "beige": (0.9, 0.78, 0.6),
}
"""Red, green and blue of the named colours."""
GRAY_SHARE = 0.1
"""Largest spread of the components of black, gray and white, as a share of the largest."""
GRAY_RANGE = (0.2, 0.9)
"""Largest components of gray; black is darker, white is lighter."""
NUMBERS = (
    *("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"),
    *("eleven", "twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen"),
)
"""Words of the numbers; larger ones are digits."""


def color_name(color: Color) -> str:
    """Return the name of a colour: black, gray, white, or the nearest of `COLOR_NAMES`.

    Shades are compared at the same brightness, and the brightness beside them.
    """
    brightness = max(color[:3])
    if brightness - min(color[:3]) <= GRAY_SHARE * brightness:
        dark, light = GRAY_RANGE
        return "black" if brightness < dark else "white" if brightness > light else "gray"

    def distance(name: str) -> float:
        other = COLOR_NAMES[name]
        largest = max(other)
        shades = zip(color, other, strict=False)
        shade = sum((a / brightness - b / largest) ** 2 for a, b in shades)
        return shade + (brightness - largest) ** 2

    return min(COLOR_NAMES, key=distance)


def colored(body: Body, noun: str) -> str:
    """Return a noun after the colour of a body: "red block"."""
    return f"{color_name(body.shape.color)} {noun}"


def counted(number: int, noun: str) -> str:
    """Return a noun after its number: "two cubes", or "cube" for one."""
    if number == 1:
        return noun
    return f"{NUMBERS[number] if number < len(NUMBERS) else number} {noun}{_plural(noun)}"


def _plural(noun: str) -> str:
    return "es" if noun.endswith("x") else "s"


def joined(phrases: Sequence[str]) -> str:
    """Return phrases as a list: "a, b and c"."""
    *first, last = phrases
    return f"{', '.join(first)} and {last}" if first else last


def structure_instruction(blueprint: Blueprint, bodies: Sequence[tuple[str, Body]]) -> str:
    """Return the instruction to build a structure.

    Pieces of a kind are interchangeable, as they are in the goal.

    Args:
        blueprint: the structure.
        bodies: kind and body of each piece.
    """
    layers: list[tuple[str, tuple[int, ...], int]] = []  # kind, supports, number of pieces
    for slot in blueprint.slots:
        kind, count = slot.piece.kind, 1
        if layers and layers[-1][:2] == (kind, slot.on):
            count += layers.pop()[2]
        layers.append((kind, slot.on, count))
    placed: dict[str, int] = {}

    def pieces(kind: str, count: int) -> str:
        """Return the phrase for the next pieces of a kind."""
        placed[kind] = placed.get(kind, 0) + count
        colors = [color_name(body.shape.color) for other, body in bodies if other == kind]
        is_uniform = len(set(colors)) == 1
        if count == len(colors):
            if not is_uniform:
                return joined([f"the {color} {kind}" for color in colors])
            return f"the {counted(count, f'{colors[0]} {kind}')}"
        phrase = counted(count, f"{colors[0]} {kind}" if is_uniform else kind)
        if placed[kind] == len(colors):
            return f"the other {phrase}"
        return phrase if count > 1 else f"a {phrase}"

    kind, _, count = layers[0]
    height = 1  # layers of single pieces of this kind from the ground up
    while height < len(layers) and layers[height - 1][2] == 1 and layers[height][0] == kind:
        height += 1
    base = pieces(kind, count * height)
    clauses = [f"stack {base}"] if height > 1 else []
    for i, (kind, on, count) in enumerate(layers[height:]):
        if i or height > 1:
            where = "on top" if len(on) == 1 else "across them"
        else:
            where = f"{'on' if len(on) == 1 else 'across'} {base}"
        clauses.append(f"put {pieces(kind, count)} {where}")
    return joined(clauses) if len(clauses) < 3 else ", then ".join(clauses)
