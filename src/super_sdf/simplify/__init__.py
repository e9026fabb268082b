"""Fewer triangles for a finished mesh, at a measured distance from it.

The library pyfqmr collapses edges by quadric error; what it made is measured and checked here.
"""
