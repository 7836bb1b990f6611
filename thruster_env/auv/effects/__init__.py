"""Disturbances of the vehicle: sensor effects and the current."""
