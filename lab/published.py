"""Published figures, as rows to compare with; they are of other shapes.

The shapes are Thingi30, 30 of Thingi10K, normalised and measured in the same way.

References
----------
SUPER-SDF: Sparse SDF Super-Resolution for Surface Extraction: its Tables 1 to 3 and Fig. 9; of its
supplement Tables 1 to 3. The figures of MES, RFTA and PoNQ are those it gives.
"""

from __future__ import annotations

from typing import Any

from .metrics import METRICS

PAPER = "SUPER-SDF (paper)"
COLUMNS = ("cd", "f1", "nc", "field_mse", "field_mae")
MC, TRILINEAR, SPLINE = (f"{first}marching cubes" for first in ("", "trilinear + ", "B-spline + "))
# Tables 3 and 1 by size and method: CD x1e5, F1, NC; mean squared x1e6 and absolute error x1e4 of
# the field in the band.
SURFACES: dict[int, dict[str, tuple[float, ...]]] = {
    32: {
        MC: (9.124, 0.606, 0.905),
        TRILINEAR: (8.622, 0.632, 0.918, 7.19, 17.7),
        SPLINE: (6.514, 0.743, 0.937, 3.10, 11.4),
        "MES": (9.528, 0.454, 0.925),
        "RFTA": (3.339, 0.698, 0.935),
        "PoNQ": (1.363, 0.810, 0.942),
        PAPER: (1.351, 0.820, 0.950, 1.82, 8.51),
    },
    64: {
        MC: (1.166, 0.854, 0.952),
        TRILINEAR: (1.086, 0.868, 0.961, 1.11, 6.38),
        SPLINE: (0.815, 0.912, 0.973, 0.459, 4.01),
        "RFTA": (1.180, 0.869, 0.963),
        "PoNQ": (0.775, 0.924, 0.971),
        PAPER: (0.711, 0.925, 0.977, 0.255, 3.15),
    },
    128: {
        MC: (0.677, 0.933, 0.978),
        TRILINEAR: (0.667, 0.935, 0.982, 0.151, 2.10),
        SPLINE: (0.643, 0.938, 0.988, 0.0534, 1.23),
        "RFTA": (0.926, 0.906, 0.975),
        "PoNQ": (0.640, 0.939, 0.984),
        PAPER: (0.638, 0.939, 0.988, 0.030, 1.14),
    },
}
# Supplement, Table 1: F1 at 32^3 by noise in percent, of marching cubes and of the paper's method.
NOISE = {0: (0.605, 0.820), 20: (0.569, 0.754), 50: (0.430, 0.487), 100: (0.283, 0.286)}
# Supplement, Table 3: CD x1e5, F1, NC by scale, at 32^3.
SCALED = {0.25: (13.826, 0.425, 0.871), 0.50: (2.653, 0.701, 0.929), 0.75: (1.252, 0.834, 0.953)}


def row_of(method: str, figures: tuple[float, ...], **words: Any) -> dict[str, Any]:
    """Return published figures as a row of ours, marked as such."""
    in_units = {key: figure / METRICS[key].scale for key, figure in zip(COLUMNS, figures)}
    return {"method": f"*{method}, published*", **words, **in_units}


def surfaces(size: int) -> list[dict[str, Any]]:
    return [row_of(method, found) for method, found in SURFACES.get(size, {}).items()]


NOISY = [
    {**row_of(method, ()), "noise": share, "f1": f1}
    for share, both in NOISE.items() for method, f1 in zip((MC, PAPER), both)
]  # fmt: skip
SCALED_ROWS = [row_of(PAPER, found, scale=scale) for scale, found in SCALED.items()]
