"""Parts of the tasks that build a structure from pieces."""
