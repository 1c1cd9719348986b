"""What `recipes/measure.py` and `recipes/fingerprint.py` run: measurements, and records of results.

Times on different machines are not comparable, so each is also given as a multiple of a unit of
work that is timed alternately in the same process: a step of PyBullet for the simulation, a
convolution for the learner. A function decorated with `table.measurement` adds rows.
"""
