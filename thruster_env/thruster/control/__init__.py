"""Controllers of the thruster: PI, LQR, and those that plan with its own equations."""
