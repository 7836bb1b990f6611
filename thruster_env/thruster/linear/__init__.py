"""Steady states, linearisation, its analysis, and the published linear systems."""
