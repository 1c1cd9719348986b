"""Layers on escnn's bases of steerable kernels, and the CPU kernels behind them."""
