"""Classical controllers of the vehicle."""
