"""The thruster's scenarios, and its parameters for identification."""
