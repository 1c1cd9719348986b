"""Loss modules, after TorchRL's contract."""
