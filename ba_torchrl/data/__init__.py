"""Demonstrations, replay, sampling and augmentation."""
