"""A grid is read at most three times: the census, a look beside the surface, the survey."""

import numpy as np
import pytest
from test_field_kinds import box

from super_sdf import make_grid
from super_sdf.grid import census
from super_sdf.grid.planes import SamplePlanes
from super_sdf.refine.survey import survey

RANDOM = np.random.default_rng(0)


class Counted(SamplePlanes):
    """An array whose planes are counted as they are read."""

    name = "the grid"

    def __init__(self, values):
        self.values, self.shape, self.dtype = values, values.shape, values.dtype
        self.reads = np.zeros(len(values), int)

    def read(self, first, last):
        self.reads[first:last] += 1
        return self.values[first:last].copy()


def with_nan(values):
    """Return truncated distances that are unknown beyond where they were cut off."""
    return np.where(np.abs(values) < 3, values, np.nan)


def plate():
    """Return distances to a plate between two planes of samples."""
    apart = np.abs(np.indices((24, 24, 24)).T - 11.5).T - np.reshape([7.3, 8.1, 0.2], (3, 1, 1, 1))
    return np.linalg.norm(np.maximum(apart, 0), axis=0) + np.minimum(apart.max(0), 0)


KINDS = {
    "exact": ("exact", box()),
    "truncated": ("truncated", np.clip(box(), -2, 2)),
    "mask": ("mask", box() < 0),
    "mask of numbers": ("mask", np.where(box() < 0, -1.0, 1.0)),
    "scaled": ("scaled", box() * np.exp(0.02 * box())),
    "noisy": ("noisy", box() + RANDOM.normal(0, 0.2, box().shape)),
    "NaN": ("truncated", with_nan(box())),
    "thin": ("exact", plate()),
}


@pytest.mark.parametrize("small", [True, False], ids=["kept", "not kept"])
@pytest.mark.parametrize("name", KINDS)
def test_a_grid_is_read_at_most_three_times_and_taken_the_same_in_parts(name, small, monkeypatch):
    kind, values = KINDS[name]
    want = make_grid(values, spacing=1.0, origin=0.0)
    if not small:  # in several parts
        monkeypatch.setattr(census, "KEPT_BYTES", 0)
        monkeypatch.setattr(census, "TOGETHER", values[0].size)
        monkeypatch.setattr(census, "READ_SAMPLES", 4 * values[0].size)
    counted = Counted(values)
    grid = make_grid(counted, spacing=1.0, origin=0.0)
    assert grid.field.kind == kind == want.field.kind and grid.notes == want.notes
    band, reads = survey(grid), counted.reads.copy()
    assert np.array_equal(band.patches, survey(want).patches)
    # blocks of the survey share two planes, and those of filled samples some more
    assert np.median(reads) <= 3 and (reads <= 6).all()
