"""Scalars, plots and videos."""
