"""The names of methods, peers and experiments: what the command accepts, and what tables call it.

NumPy is not imported here, so the command's help takes them from here without loading it.
"""

from __future__ import annotations

from ..steps.mesher_names import DEFAULT_MESHER, MARCHING
from ..steps.mesher_names import MESHERS as MESHERS

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

MESHED = (OURS, "bound")  # the methods that every mesher is measured with


def meshed_by(method: str, mesher: str) -> str:
    """Return the name of one of ``MESHED`` with a mesher; with the default it is the method's own.

    The default mesher is that of the main tables.
    """
    return method if mesher == DEFAULT_MESHER else f"{method}-{mesher}"


# The measurements that depend on the code and the network of this package: all of ours, and those
# of the bound with meshers that are this package's. (Its marching cubes is scikit-image's.)
OF_OUR_CODE = (
    PROCESS,
    *(meshed_by(OURS, mesher) for mesher in MESHERS),
    *(meshed_by("bound", mesher) for mesher in MESHERS if mesher != MARCHING),
)
