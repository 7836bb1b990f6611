"""A recorded ROV thruster on a load cell: identified from its logs, estimated without the load cell, and compared."""
