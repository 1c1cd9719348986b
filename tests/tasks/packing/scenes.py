"""Task ids of the packing tasks."""

import math

BIN, BOTTLES, BOXES = (
    f"open_loop/{name}" for name in ("bin_packing", "bottle_arrangement", "box_palletizing")
)
QUARTER_TURN = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
"""A quarter turn about x."""
