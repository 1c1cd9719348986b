"""Rigid transforms of sampled transitions."""
