"""Converting many grids: find the inputs, plan, convert in several processes, resume.

The command is ``super-sdf batch``. This room may import ``convert`` and what lies below it.
"""
