"""How filters run: their memory, compiled steps, batches and sessions.

A belief is one row of floats and, for an ensemble, a table with a column a member; a model's numbers are a row. A
batch of a filter with a page carries 32 beliefs side by side, and each instruction is one for eight of them: an
extended Kalman step takes 0.05 us of a core in place of 0.19. A filter restarts from the prior if its estimate is
not finite or a variance is negative. An indefinite P with positive variances is not looked for: a factorisation in
every step would cost as much as the update, and `form="square-root"` cannot have one.
"""
