"""Algorithms: networks, losses and data tied together."""
