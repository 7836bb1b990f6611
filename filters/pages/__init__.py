"""Filters as pages of a textbook, pure functions of small matrices, and what runs them.

page, own         what a page is made of, and a filter that is made of a page
equations, traced a model as pages see it: f, F, h, H, Q, R of matrices
differences, at_points  the same of functions that cannot be traced, which are called
stages, kernels   a page as programs in the memory of a belief
"""
