"""Cameras: depth, height and colour images, and in-hand images."""
