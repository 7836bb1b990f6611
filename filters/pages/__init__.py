"""Filters as pages of a textbook, pure functions of small matrices, and what runs them.

page         a page, its parameters, its matrices in memory, and the model that it gets: f, F, h, H, Q, R
kernels      the stages of a page, also of an ensemble's members, as programs or calls: kernels of the engine

From a page to machine code, in steps:

1. Called with Matrices, a page records its operations (`filters.algebra`); each knows its derivative, so a stage
   with derivatives is a graph of values and one of slopes along a parameter.
2. The model's functions are traced (`thruster_env.model.traced`), and all matrices are expanded into numbers
   (`thruster_env.graphs`).
3. The program of a stage goes to LLVM as instructions for eight runs, or for one belief on scalars, together with
   the loops around it (`filters.engine`, `thruster_env.graphs.loops`): a batch works on four groups of eight
   beliefs at a time.
4. A page of members or particles becomes loops over them; a sum over members ends a loop.

A page traced for a model's sizes is a program without calls; operations of larger models, and of models that
cannot be traced, are calls of functions for their sizes: above 30 000 operations a stage (14 000, or 600 sums,
of members). A page names and returns the extras of a filter, such as an estimate of R or a root of P. The
Gaussian sum and the fuzzy filter have a page for one part of a mixture, which a loop runs on all parts: without
the loop, 64 rules of six states would be tens of thousands of operations. Filters of several models, `mhe` and
baselines are loops over filters or steps, and have no page.
"""
