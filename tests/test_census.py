"""Grids that are read by planes, and in parts, are taken as arrays in memory are."""

import numpy as np
import pytest
from test_field_kinds import box

from super_sdf import make_grid
from super_sdf.grid import census, samples
from super_sdf.grid.sdf_grid import crop

NOISE = np.random.default_rng(0).normal(0, 0.2, (32, 32, 32))
APART = np.abs(np.indices((32,) * 3).T - 15.5).T - np.reshape([7.3, 8.1, 0.2], (3, 1, 1, 1))
KINDS = {
    "exact": ("exact", box()),
    "truncated": ("truncated", np.clip(box(), -2, 2)),
    "truncated at 1": ("truncated", np.clip(box(), -1, 1)),
    "truncated at .5": ("truncated", np.clip(box(), -0.5, 0.5)),
    "mask": ("mask", box() < 0),
    "mask of numbers": ("mask", np.where(box() < 0, -1.0, 1.0)),
    "scaled": ("scaled", box() * np.exp(0.02 * box())),
    "noisy": ("noisy", box() + NOISE),
    "NaN": ("truncated", np.where(np.abs(box()) < 3, box(), np.nan)),
    "thin": ("exact", np.linalg.norm(np.maximum(APART, 0), axis=0) + np.minimum(APART.max(0), 0)),
}


class Stored(samples.SamplePlanes):
    """An array that is read by planes."""

    def __init__(self, values):
        self.values, self.shape, self.dtype = values, values.shape, values.dtype

    def read(self, first, last):
        return self.values[first:last].copy()


@pytest.mark.parametrize("name", KINDS)
def test_planes_and_parts_are_taken_as_the_whole_array_is(name, monkeypatch):
    kind, values = KINDS[name]
    want = make_grid(values, spacing=1.0, origin=0.0)
    monkeypatch.setattr(census, "KEPT_BYTES", 0)
    monkeypatch.setattr(census, "TOGETHER", values[0].size)
    monkeypatch.setattr(samples, "WORKING_BYTES", 1)
    grid = make_grid(Stored(values), spacing=1.0, origin=0.0)
    assert grid.field.kind == kind == want.field.kind and grid.notes == want.notes
    assert grid.field.report() == want.field.report()
    np.testing.assert_array_equal(grid.values, want.values)
    low, high = (3, 9, 14), (21, 24, 32)
    part = crop(grid, low, high)
    np.testing.assert_array_equal(part.values, want.values[3:21, 9:24, 14:32])
    assert part.origin == low and (part.low, part.high) == (want.low, want.high)
