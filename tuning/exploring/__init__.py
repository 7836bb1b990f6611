"""What an interactive bench shows: a filter's estimates, consistency and figures for any of its numbers."""
