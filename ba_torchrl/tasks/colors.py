"""Colours of the objects, RGBA."""

from ba_torchrl.sim.shapes import Color

RED: Color = (0.82, 0.22, 0.2, 1.0)
BLUE: Color = (0.2, 0.4, 0.8, 1.0)
GREEN: Color = (0.35, 0.7, 0.35, 1.0)
ORANGE: Color = (0.9, 0.55, 0.15, 1.0)
