"""How filters run: their memory, compiled steps, batches and sessions."""
