"""What tests of pages share: a grid without symmetry, and the JSON of a page read back."""

import json
import re
from pathlib import Path

import numpy as np
from solids import box_distance


def wedge(n=24):
    """Distances to a box with sides of three lengths, off the middle, in spacings."""
    ijk = np.moveaxis(np.indices((n, n, n)), 0, -1)
    return box_distance(ijk - [11.3, 12.1, 11.7], [8.2, 5.3, 3.1]).astype(np.float32)


def blocks(page):
    """Return the JSON of a page's blocks by their id."""
    text = page if isinstance(page, str) else Path(page).read_text("utf-8")
    pattern = r'<script type="application/json" id="([\w-]+)">(.*?)</script>'
    return {name: json.loads(said) for name, said in re.findall(pattern, text, re.DOTALL)}
