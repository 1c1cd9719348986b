"""Meshes."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.meshes import lathe_parts


def test_a_lathe_turns_its_profile():
    lower, upper = lathe_parts([(0.02, 0.0), (0.03, 0.05), (0.01, 0.09)], sides=12)
    for part, ends in ((lower, ((0.02, 0.0), (0.03, 0.05))), (upper, ((0.03, 0.05), (0.01, 0.09)))):
        for radius, z in ends:
            ring = part.vertices[np.isclose(part.vertices[:, 2], z)]
            assert len(ring) == 12
            assert np.hypot(ring[:, 0], ring[:, 1]) == pytest.approx(np.full(12, radius))
        corners = part.vertices[part.faces]
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        (r0, z0), (r1, z1) = ends
        area = 12 / 2 * math.sin(2 * math.pi / 12)  # of the polygon with unit radius
        assert volume == pytest.approx(area * (r0 * r0 + r0 * r1 + r1 * r1) / 3 * (z1 - z0))
