"""Grids of runs: the plan, the jobs, and the process of one run."""
