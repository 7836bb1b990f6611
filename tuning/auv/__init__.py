"""The underwater vehicle's scenarios."""
