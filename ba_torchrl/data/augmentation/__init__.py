"""Rigid motions of sampled transitions."""
