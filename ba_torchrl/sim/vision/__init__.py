"""Cameras: depth, height and colour images, and images of the held object."""
