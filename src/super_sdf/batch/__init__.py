"""Many grids to meshes: found, planned, shared out, resumed. The command is ``super-sdf batch``.

It may import ``convert`` and what lies below.
"""
