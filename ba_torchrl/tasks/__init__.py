"""What there is to do: one file per task, each with its goal and expert."""
