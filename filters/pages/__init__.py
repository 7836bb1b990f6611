"""Filters as pages of a textbook, pure functions of small matrices, and what runs them.

page         a page, its parameters, and the layout of its matrices in memory
page_filter  a filter that has a page
equations    the model that pages get: f, F, h, H, Q, R of matrices; central differences of called functions
traced       a model's functions and their derivatives as graphs of numbers
kernels      the stages of a page, as programs or calls, and as kernels of the engine
members      the same of an ensemble filter, whose equations of a member are evaluated for each member

A page traced for a model's sizes is a program without calls, for one belief and for eight side by side; operations
of larger models, and of models that cannot be traced, are calls of functions for their sizes. A page names and
returns the extras of a filter, such as an estimate of R or a root of P. The Gaussian sum and the fuzzy filter have
a page for one part of a mixture, which a loop runs on all parts: without the loop, 64 rules of six states would be
tens of thousands of operations. Filters of several models, `mhe` and baselines are loops over filters or steps,
and have no page.
"""
