"""What tests of pages share: a grid without symmetry, and the JSON of a page read back."""

import json
import re
from pathlib import Path

import numpy as np


def wedge(n=24):
    """Distances to a box with sides of three lengths, off the middle, in spacings."""
    ijk = np.indices((n, n, n)) - np.array([11.3, 12.1, 11.7])[:, None, None, None]
    away = np.abs(ijk) - np.array([8.2, 5.3, 3.1])[:, None, None, None]
    outside = np.linalg.norm(np.maximum(away, 0), axis=0)
    return (outside + np.minimum(away.max(0), 0)).astype(np.float32)


def blocks(page):
    """Return the JSON of a page's blocks by their id."""
    text = page if isinstance(page, str) else Path(page).read_text("utf-8")
    pattern = r'<script type="application/json" id="([\w-]+)">(.*?)</script>'
    return {name: json.loads(said) for name, said in re.findall(pattern, text, re.DOTALL)}
