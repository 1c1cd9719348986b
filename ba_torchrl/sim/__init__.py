"""The simulator: PyBullet worlds, bodies, robots and cameras; knows no torch."""
