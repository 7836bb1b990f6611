"""The scenarios of this package's plants, thruster and vehicle, and a thruster's logs."""
