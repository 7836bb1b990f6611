"""Disturbances of a thruster: amplifier, ambient flow, reference signals and uncertain parameters."""
