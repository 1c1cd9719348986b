"""What a step, an image and an update cost, against the project's budgets and a unit of work.

Machines differ by more than programs do, so every time is also given as a multiple of a unit that
is timed in between, in the same process: a step of PyBullet for the simulation, a convolution for
the learner. To add a row, write a function in one of these files, or in a new one, and decorate it
with `table.measurement`.
"""
