"""The plants that policies learn on, and what training has to know of each."""
