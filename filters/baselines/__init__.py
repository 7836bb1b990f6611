"""What a filter has to beat: open loop, low-pass and inversion."""
