"""Tasks that build a structure from pieces."""
