"""Moving-horizon estimation: the states of a window, estimated together at each step."""
