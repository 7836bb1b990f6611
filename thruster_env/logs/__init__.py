"""Recorded runs of a plant: logs of inputs and measurements, read from files put on a regular grid of times."""
