"""Filters whose belief is a weighted sample of states."""
