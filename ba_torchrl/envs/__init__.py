"""TorchRL environments."""
