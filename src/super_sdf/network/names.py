"""The names of devices, precisions and shipped networks, for help texts: imports nothing."""

DEVICES = ("auto", "cpu", "cuda")
PRECISIONS = ("float32", "int8")
DEFAULT_QUALITY = "base"
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 4)}
"""The file of a shipped network, and the number of cube symmetries that are averaged."""
