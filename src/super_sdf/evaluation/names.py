"""The names of methods, peers and experiments: what the command accepts, and what tables call it.

Nothing is imported here, so the command's help takes them from here without loading NumPy.
"""

from __future__ import annotations

OURS = "ours"
FLOOR = "floor"  # not a method: the reference measured against itself
PROCESS = "process"  # not a method: whole processes of the command, timed

# What tables call each method, by the name that the command accepts.
METHOD_LABELS = {
    "mc": "MC",
    "mc-lewiner": "MC, Lewiner's table",
    "trilinear": "trilinear + MC",
    "bspline": "B-spline + MC",
    OURS: "super-sdf",
    "bound": "bound: true distance at the nodes",
}
PEER_LABELS = {"rfta": "RFTA", "dual-contouring": "dual contouring of distances"}
LABELS = {**METHOD_LABELS, **PEER_LABELS, FLOOR: "floor: the reference against itself"}

EXPERIMENTS = ("factors", "noise", "iterated", "scale", "timings", "meshers")

# What turns a field into triangles. The first is that of the main tables; add others behind it.
MESHERS: tuple[str, ...] = ("marching", "sharp")
MESHED = (OURS, "bound")  # the methods that every mesher is measured with


def meshed_by(method: str, mesher: str) -> str:
    """Return the name of one of ``MESHED`` with a mesher; with the first it is the method's own."""
    return method if mesher == MESHERS[0] else f"{method}-{mesher}"


# The measurements that depend on the code and the network of this package: all of ours, and those
# of the bound with meshers that are this package's. (The first is scikit-image's.)
OF_OUR_CODE = (
    *(OURS, PROCESS),
    *(meshed_by(method, mesher) for mesher in MESHERS[1:] for method in MESHED),
)
