"""Plain functions of floats as graphs of numbers, and programs made from these graphs.

graphs, folding  numbers that record operations, their derivatives, and simplification
tracing          the graph of a function; branches: of a function that decides
programs         a graph as a program for some runs side by side, or for members, cut into loops; its C99
instructions     a program as instructions of LLVM
loops            the loops around programs, from their source; expressions, forms, arithmetic: what they compute
machine_code     instructions of LLVM as functions of Python, compiled, kept on disk and freed
workers          such functions in parts, shared by worker threads
python_floats    functions that run as Python

What can be traced, and the arithmetic of programs: docs/machine_code.md. A program is compared with its function
at a few points, since a function might check the type of its argument.
"""
