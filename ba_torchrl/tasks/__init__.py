"""The tasks: bodies, random initial poses, conditions of success, and experts."""
