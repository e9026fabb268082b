"""One module per grid file format: each turns a ``Request`` into a ``Volume``.

A reader says what the file says, in the world coordinates of the file, and imports its library when
it is called. It may raise anything: ``files.grids`` turns what a library raises into one line.
"""
