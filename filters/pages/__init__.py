"""Filters as pages of a textbook, pure functions of small matrices, and what runs them.

page, page_filter       what a page is made of, and a filter that has one
equations, traced       a model as pages see it: f, F, h, H, Q, R of matrices
differences, at_points  the same of functions that cannot be traced, which are called
memory, stages          where matrices lie, and what a page stores there
members                 a page of an ensemble as kernels: what it says of a member is done for each of them
programs, kernels       a page as programs or calls, and as kernels of the engine

A page traced for a model's sizes is a program without calls, for one belief and for eight side by side; operations
of larger models, and of those that cannot be traced, are calls of functions for their sizes. What a filter carries
besides mean and covariance (an estimate of R, a root of P) its page names and returns. The Gaussian sum and the
fuzzy filter have a page for one part of a mixture, which a loop runs on all parts: written out for 64 rules of six
states they would be tens of thousands of operations. Filters of several models, `mhe` and baselines are loops over
filters or steps, and have no page.
"""
