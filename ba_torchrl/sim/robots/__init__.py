"""Robots: arms with grippers, one file for each arm."""
