"""Q and R of one column of numbers, in one line: `tuning.fit`.

column      the numbers and their times, read as logs are
likelihood  of the numbers under a named model, with its gradient
recursion   the filter of that likelihood, for all models and steps, as machine code
fit         named models by maximum likelihood, with intervals, and the choice among them
outliers    numbers that no normal noise explains, and jumps
answer      what is found, on half a page, with a picture
paste       the filter as lines of other packages and of a controller
"""
