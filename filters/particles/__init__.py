"""Filters whose belief is a weighted sample of states.

A page is written for one particle, whose weight is a logarithm; `filters.algebra.points` has weights, weighted
moments and the effective sample size. Resampling reorders particles, so it runs between the functions of the page;
these pages are neither in C nor on tensors.
"""
