"""Support surfaces of the objects: the floor, the tray, ramps and bumps."""
