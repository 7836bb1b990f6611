"""What disturbs the vehicle: its sensors, and the current that it goes in."""
