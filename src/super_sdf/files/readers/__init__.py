"""The readers of grid files, a module for each library: each turns a Request into a Volume.

A reader says what the file says, in the world coordinates of the file. It may raise anything:
``files.grids`` turns what a library raises into one line.
"""
