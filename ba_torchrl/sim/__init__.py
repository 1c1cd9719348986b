"""The simulator: PyBullet worlds, bodies, robots, controllers and cameras, without torch."""
