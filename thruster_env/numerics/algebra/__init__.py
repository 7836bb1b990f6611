"""Algebra that is written once, as in a textbook, and worked out, differentiated and compiled by programs.

graphs, folding, tracing          what a plain function of floats computes, as a graph of numbers
branches                          the same of a function that decides: a choice between what it does on each side
slopes                            derivatives of such a graph
magnitudes                        what is known of a number's size
matrices, operations, densities   what is computed of matrices: A @ B.T, divide(C, S), log_density(v, S, seen)
points                            roots of covariances, and sigma points as columns of a matrix
scalars, blocks, upper            numbers, choices and weights; inverses, triangles, blocks; factors U, D
members, geometric                means and covariances of ensembles; the geometric mean of two covariances
derivatives                       of matrices, by the rules of matrix calculus
precision                         constants in single precision
programs, instructions            a graph of numbers as machine code, for some runs side by side
loops, loop_instructions          the same for the members of an ensemble, cut into loops
c_source                          the same as C99
calls, with *_called              a graph of matrices as calls of functions for its sizes, for any model
"""
