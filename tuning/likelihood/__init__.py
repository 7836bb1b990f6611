"""Parameters by maximum likelihood, of noise and of plants, and what data determine of them."""
