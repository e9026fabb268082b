"""The names of methods, peers and experiments: what the command accepts, and what tables call it.

NumPy is not imported here, so the command's help takes them from here without loading it.
"""

from __future__ import annotations

from ..options import DEFAULT_MESHER, MARCHING
from ..options import MESHERS as MESHERS

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

EXPERIMENTS = ("factors", "noise", "iterated", "scale", "timings", "meshers", "fields")

# What is done with grids that are not exact distances. Their names end in " on " and the kind.
WIDTHS = (0.5, 0.8, 1.2)  # voxels, of the Gaussians by which masks are smoothed
BY_HAND_LABELS = {
    "linear-finest": "by hand to the finest spacing, linear, super-sdf",
    "spline-finest": "by hand to the finest spacing, cubic spline, super-sdf",
    "spline-coarsest": "by hand to the coarsest spacing, cubic spline, super-sdf",
}
FIELD_METHOD_LABELS = {
    "mc": METHOD_LABELS["mc"],
    "mc-distances": "MC of SciPy's distance transform",
    **{f"mc-gaussian-{width:g}": f"MC, Gaussian of {width:g} voxels" for width in WIDTHS},
    "bspline": METHOD_LABELS["bspline"],
    **BY_HAND_LABELS,
    OURS: METHOD_LABELS[OURS],
}
ON = " on "
# Groups of kinds of grids, of which the experiment "fields" may measure some.
FIELD_GROUPS = ("exact", "mask", "truncated", "scaled", "density", "noisy", "unequal")

MESHED = (OURS, "bound")  # the methods that every mesher is measured with


def meshed_by(method: str, mesher: str) -> str:
    """Return the name of one of ``MESHED`` with a mesher; with the default it is the method's own.

    The default mesher is that of the main tables.
    """
    return method if mesher == DEFAULT_MESHER else f"{method}-{mesher}"


def simplified(method: str, share: int) -> str:
    """Return the name of a method whose mesh is simplified to a share of its triangles."""
    return f"{method}/{share}"


def matched(method: str, peer: str) -> str:
    """Return the name of a method whose mesh is simplified to as many triangles as a peer's."""
    return f"{method}/{peer}"


def on_kind(method: str, kind: str) -> str:
    """Return the name of a method on a kind of grid: see ``field_kinds.KINDS``."""
    return f"{method}{ON}{kind}"


def is_of_our_code(method: str) -> bool:
    """Return whether a measurement depends on the code and the network of this package."""
    return method.split(ON)[0] in OF_OUR_CODE


OURS_MESHED = {mesher: meshed_by(OURS, mesher) for mesher in MESHERS}
SHARES = (4, 16)  # of the triangles: a quarter and a sixteenth are left
SIMPLIFIED = {simplified(name, n): (name, n) for name in OURS_MESHED.values() for n in SHARES}
MATCHED = {
    matched(name, peer): (name, peer) for peer in PEER_LABELS for name in OURS_MESHED.values()
}
OURS_LABELS = {name: f"super-sdf, {mesher}" for mesher, name in OURS_MESHED.items()}
LABELS = {
    **OURS_LABELS,
    **METHOD_LABELS,
    **PEER_LABELS,
    **{
        name: f"{OURS_LABELS[ours]}, as many triangles as {PEER_LABELS[peer]}"
        for name, (ours, peer) in MATCHED.items()
    },
    FLOOR: "floor: the reference against itself",
}

# The measurements that depend on the code and the network of this package: all of ours, and those
# of the bound with meshers that are this package's. (Its marching cubes is scikit-image's.)
OF_OUR_CODE = (
    PROCESS,
    *BY_HAND_LABELS,
    *OURS_LABELS,
    *SIMPLIFIED,
    *MATCHED,
    *(meshed_by("bound", mesher) for mesher in MESHERS if mesher != MARCHING),
)
