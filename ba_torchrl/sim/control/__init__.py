"""Motion of the arm: close-loop displacements, picks and places."""
