"""Does a better estimate make a better controller? Policies on raw, filtered and true state, side by side."""
