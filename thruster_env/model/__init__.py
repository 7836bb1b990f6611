"""State-space models: Gaussian, affine, of continuous time; truth drawn from them."""
