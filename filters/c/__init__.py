"""Filters as C99 for a controller: no heap, no recursion, no library but math.h.

programs    a page's functions as programs, with the numbers of a model in them
source      NAME.h and NAME.c of these: writer, and of an ensemble's members ensemble
monitor     tests of the innovations in them
cpp         NAME.hpp, a class of C++ around them
sizes       bytes of the struct, the stack and the code
project     a folder with these, a program that filters a log (log_program), and how to build them
single      how far floats in place of doubles move the estimates

The text is that of the programs that machine code is made of; only the place of a number differs. The model's
numbers are constants there: zeros vanish, and a step takes a third to a half of the time. The price is a new
export for another Q.
"""
