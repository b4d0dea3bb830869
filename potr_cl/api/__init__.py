"""What a program asks for in one call: the commands of the command line as functions, with the same keywords.

The top-level names of :mod:`potr_cl` lead here. Each takes scenes and cameras as objects or as paths, and returns a
result that says in one line what it is, and shows pictures in notebooks. :mod:`potr_cl.cli` calls the same functions.
"""
