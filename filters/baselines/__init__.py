"""Baselines for filters: open loop, low-pass and inversion."""
