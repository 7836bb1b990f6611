"""Policies on raw, filtered and true state. Needs the extra `rl`; importing this package alone does not."""
