"""The page of `thruster explore`: it shows and asks, and computes nothing."""
