"""Moving-horizon estimation: all states of a window are estimated at each step."""
