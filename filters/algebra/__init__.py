"""Matrices as a textbook writes them, the language of filters' pages; `thruster_env.graphs` evaluates them.

matrices, operations    A @ B.T, divide(C, S), sym(P), only(present(z), H), and their derivatives
samples                 weighted samples; log_density(v, S, present(z))
points                  roots of covariances, and sigma points as columns of a matrix
scalars, blocks, upper  numbers and choices; inverses, triangles, blocks; factors U, D
members, geometric      means and covariances of ensembles; the geometric mean of two covariances
calls                   a graph of matrices as calls of functions for its sizes, for any model
"""
