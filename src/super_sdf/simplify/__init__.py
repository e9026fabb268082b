"""Fewer triangles for a finished mesh, at a measured distance from it (extra ``simplify``)."""
