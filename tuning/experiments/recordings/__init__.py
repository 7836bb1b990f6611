"""A recorded ROV thruster on a load cell: identified from its logs, then estimated without the load cell."""
