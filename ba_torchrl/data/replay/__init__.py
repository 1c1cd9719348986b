"""Replay buffers, their codecs and samplers."""
