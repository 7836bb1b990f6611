"""Tuning on problems as users have them: whether a tuned filter is ever worse than what they had before."""
