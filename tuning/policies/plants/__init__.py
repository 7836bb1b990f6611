"""The plants on which policies learn."""
