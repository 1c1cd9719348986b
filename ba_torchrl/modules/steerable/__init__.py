"""Layers on bases of steerable kernels, and the CPU kernels behind them."""
