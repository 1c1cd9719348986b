"""The experiment loop, evaluation and checkpoints."""
