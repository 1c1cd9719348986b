"""What the tasks share that place objects in a container."""
