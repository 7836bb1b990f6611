"""Plain functions of floats as graphs of numbers, and programs made from these graphs.

graphs, folding, tracing          the graph of a function
branches                          the same of a function that decides: a choice between what it does on each side
slopes                            derivatives of a graph
magnitudes                        what is known of a number's size
precision                         constants in single precision
programs, instructions            a graph as machine code, for some runs side by side
loops, loop_instructions          the same for the members of an ensemble, cut into loops
c_source                          the same as C99

What can be traced, and the arithmetic of programs: docs/machine_code.md. A program is compared with its function
at a few points, since a function might check the type of its argument.
"""
