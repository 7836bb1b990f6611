"""What disturbs a thruster: amplifier, ambient flow, reference signals and uncertain parameters."""
