"""Pictures of the vehicle on its way."""
