"""Filters whose belief is a Gaussian or a sum of Gaussians, carried as means and covariances."""
