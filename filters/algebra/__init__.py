"""Matrices as a textbook writes them: what a filter's page is written with; `thruster_env.graphs` works it out.

matrices, operations, densities   A @ B.T, divide(C, S), log_density(v, S, seen)
points                            roots of covariances, and sigma points as columns of a matrix
scalars, blocks, upper            numbers, choices and weights; inverses, triangles, blocks; factors U, D
members, geometric                means and covariances of ensembles; the geometric mean of two covariances
derivatives                       of matrices, by the rules of matrix calculus
calls, with *_called              a graph of matrices as calls of functions for its sizes, for any model
"""
