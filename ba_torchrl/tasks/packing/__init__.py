"""Parts of the tasks that place objects in a container."""
