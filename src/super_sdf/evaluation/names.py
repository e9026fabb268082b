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

EXPERIMENTS = ("factors", "noise", "iterated", "scale", "timings")
