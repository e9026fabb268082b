"""What users choose of a picture. It imports nothing, so that ``--help`` may show it."""

AXES = ("x", "y", "z")
COLOURS = ("shaded", "normal", "error")
