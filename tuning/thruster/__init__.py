"""The thruster's scenarios, the only room of tuning that knows a plant."""
