"""Attacks on the whole, bounded in time: `python -m tests.fuzz`.

Each takes a random generator and how long it may take [s], and returns a line with what it counted; it raises
AssertionError with what brings a fault about.
"""
