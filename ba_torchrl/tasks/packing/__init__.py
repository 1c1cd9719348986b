"""Tasks that bring objects into a container."""
