"""The names of devices, precisions and shipped networks, for help texts: imports nothing."""

DEVICES = ("auto", "cpu", "cuda")
AUTO_PRECISION, FLOAT32, INT8 = "auto", "float32", "int8"
PRECISIONS = (AUTO_PRECISION, FLOAT32, INT8)
"""The arithmetic of a network; "auto" is int8 on the CPU, for shipped networks that have it."""
DEFAULT_QUALITY = "base"
QUALITIES = {"fast": ("fast", 1), "base": ("base", 1), "best": ("base", 4)}
"""The file of a shipped network, and the number of cube symmetries that are averaged."""


def int8_name(name: str) -> str:
    """Return the name of the int8 variant of a network."""
    return f"{name}-{INT8}"


def float32_name(name: str) -> str:
    """Return the name of a network without what marks an int8 variant."""
    return name.removesuffix(f"-{INT8}")
