"""Problems of studies: found by name, with their data and scale.

A problem is a small contract (`problem`): search, likelihood and evaluation ask it and nothing else, so that they
know no plant. A bound that does not exist is NaN, and a state that does not count has an infinite scale. Code is
named by "module:object" and identified by a digest of its numbers; what a file names is never imported.
A choice of a study is arguments of the problem's model, so Q by its diagonal and a `sigma_a` from which Q follows
are treated alike.
"""
