"""Measurements of the package: times of steps, images and updates, and records to compare.

Times on different machines are not comparable, so each is also given as a multiple of a unit that
is timed in turn in the same process: a step of PyBullet for the simulation, a convolution for the
learner. A function in this package that is decorated with `table.measurement` adds rows.

`fingerprint` records what environments and training compute, bit by bit.
"""
