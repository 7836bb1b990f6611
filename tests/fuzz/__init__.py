"""Attacks on the whole, bounded in time: `python -m tests.fuzz`."""
