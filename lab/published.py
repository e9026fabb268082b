"""Published figures, as rows to compare with; they are of other shapes.

The shapes are Thingi30, 30 of Thingi10K, normalised and measured alike. ``published.json``
has the figures: surfaces by size and method (CD x1e5, F1, NC; mean squared x1e6 and absolute error
x1e4 of the field in the band); F1 at 32^3 by noise in percent, of marching cubes and of the paper's
method; CD x1e5, F1, NC at 32^3 by scale.

References
----------
SUPER-SDF: Sparse SDF Super-Resolution for Surface Extraction: its Tables 1 to 3 and Fig. 9; of its
supplement Tables 1 to 3. The figures of MES, RFTA and PoNQ are those it gives.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .metrics import METRICS

MC, PAPER = "marching cubes", "SUPER-SDF (paper)"
COLUMNS = ("cd", "f1", "nc", "field_mse", "field_mae")
STORED = json.loads(Path(__file__).with_suffix(".json").read_text())
SURFACES = {int(size): figures for size, figures in STORED["surfaces"].items()}


def row_of(method: str, figures: list[float], **words: Any) -> dict[str, Any]:
    """Return published figures as a row of ours, marked as such."""
    in_units = {key: figure / METRICS[key].scale for key, figure in zip(COLUMNS, figures)}
    return {"method": f"*{method}, published*", **words, **in_units}


def surfaces(size: int) -> list[dict[str, Any]]:
    return [row_of(method, found) for method, found in SURFACES.get(size, {}).items()]


NOISY = [
    {**row_of(method, []), "noise": int(share), "f1": f1}
    for share, both in STORED["noise"].items() for method, f1 in zip((MC, PAPER), both)
]  # fmt: skip
SCALED_ROWS = [row_of(PAPER, found, scale=float(at)) for at, found in STORED["scale"].items()]
