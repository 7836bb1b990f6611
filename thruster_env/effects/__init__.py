"""Disturbances of any plant: effects as frozen values, sensor effects and recorded series."""
