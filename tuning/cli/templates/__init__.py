"""Templates of `thruster new`: working files to adapt."""
