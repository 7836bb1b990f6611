"""Matrices as a textbook writes them, the language of filters' pages; `thruster_env.graphs` evaluates them.

matrices    symbolic matrices: A @ B.T, and the graph that they record
operations  divide(C, S), sym(P), mask_missing(present(z), H), numbers and choices, with derivatives
points      roots of covariances, sigma points, weighted samples, log_density(v, S, present(z))
roots       inverses, triangles, blocks; factors U, D
members     means and covariances of ensembles
calls       a graph of matrices as calls of functions for its sizes, for any model
"""
