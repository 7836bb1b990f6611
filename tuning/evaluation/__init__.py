"""Filters scored on data: evaluation, comparison, held-out evaluation and tuned files."""
