"""Filters as pages of a textbook, pure functions of small matrices, and what runs them.

page, page_filter       what a page is made of, and a filter that has one
equations, traced       a model as pages see it: f, F, h, H, Q, R of matrices
differences, at_points  the same of functions that cannot be traced, which are called
memory, stages          where matrices lie, and what a page stores there
members                 a page of an ensemble as kernels: what it says of a member is done for each of them
programs, kernels       a page as programs or calls, and as kernels of the engine
"""
