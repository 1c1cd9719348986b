"""Launchers: where the runs of a grid take place."""
