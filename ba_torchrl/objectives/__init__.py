"""Loss modules that follow TorchRL's contract."""
