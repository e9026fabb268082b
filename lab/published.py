"""Published figures, to compare with; they are of other shapes.

The shapes are Thingi30, 30 of Thingi10K, normalised and measured in the same way. CD x1e5.

References
----------
SUPER-SDF: Sparse SDF Super-Resolution for Surface Extraction: its Tables 1 to 3 and Fig. 9; of its
supplement Tables 1 to 3. The figures of MES, RFTA and PoNQ are those it gives.
"""

from __future__ import annotations

PAPER = "SUPER-SDF (paper)"

# Table 3: CD x1e5, F1, NC by size and method. A name that our tables use, too, is the same method.
SURFACES: dict[int, dict[str, tuple[float, float, float]]] = {
    32: {
        "MC": (9.124, 0.606, 0.905),
        "trilinear + MC": (8.622, 0.632, 0.918),
        "B-spline + MC": (6.514, 0.743, 0.937),
        "MES": (9.528, 0.454, 0.925),
        "RFTA": (3.339, 0.698, 0.935),
        "PoNQ": (1.363, 0.810, 0.942),
        PAPER: (1.351, 0.820, 0.950),
    },
    64: {
        "MC": (1.166, 0.854, 0.952),
        "trilinear + MC": (1.086, 0.868, 0.961),
        "B-spline + MC": (0.815, 0.912, 0.973),
        "RFTA": (1.180, 0.869, 0.963),
        "PoNQ": (0.775, 0.924, 0.971),
        PAPER: (0.711, 0.925, 0.977),
    },
    128: {
        "MC": (0.677, 0.933, 0.978),
        "trilinear + MC": (0.667, 0.935, 0.982),
        "B-spline + MC": (0.643, 0.938, 0.988),
        "RFTA": (0.926, 0.906, 0.975),
        "PoNQ": (0.640, 0.939, 0.984),
        PAPER: (0.638, 0.939, 0.988),
    },
}

# Table 1: mean squared and mean absolute error of the field in the band.
FIELDS: dict[int, dict[str, tuple[float, float]]] = {
    32: {
        "trilinear + MC": (7.19e-6, 1.77e-3),
        "B-spline + MC": (3.10e-6, 1.14e-3),
        PAPER: (1.82e-6, 8.51e-4),
    },
    64: {
        "trilinear + MC": (1.11e-6, 6.38e-4),
        "B-spline + MC": (4.59e-7, 4.01e-4),
        PAPER: (2.55e-7, 3.15e-4),
    },
    128: {
        "trilinear + MC": (1.51e-7, 2.10e-4),
        "B-spline + MC": (5.34e-8, 1.23e-4),
        PAPER: (3.00e-8, 1.14e-4),
    },
}

# Supplement, Table 1: F1 at 32^3 by noise, of MC and of the paper's method.
NOISE_F1: dict[float, tuple[float, float]] = {
    0.0: (0.605, 0.820),
    0.2: (0.569, 0.754),
    0.5: (0.430, 0.487),
    1.0: (0.283, 0.286),
}

# Supplement, Table 3: CD x1e5, F1, NC by scale, at 32^3.
SCALED: dict[float, tuple[float, float, float]] = {
    0.25: (13.826, 0.425, 0.871),
    0.50: (2.653, 0.701, 0.929),
    0.75: (1.252, 0.834, 0.953),
}
