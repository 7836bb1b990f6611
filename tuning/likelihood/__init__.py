"""Noise covariances by maximum likelihood, and what data determine of them."""
