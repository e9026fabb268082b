"""Every refusal's way out is tried, on a zoo of grids as people have them."""

import numpy as np
import pytest

from lab.zoo import KINDS, advised, follow, problem
from super_sdf import load_network, make_grid
from super_sdf.errors import GridError

SIZE = 24


@pytest.fixture(scope="module")
def network():
    return load_network("base", threads=1)


def test_the_zoo_has_many_kinds():
    assert len(KINDS) > 100


@pytest.mark.parametrize("name", KINDS)
def test_a_mesh_is_no_worse_than_marching_cubes_or_refused_with_a_way_there(name, network):
    sample = KINDS[name](SIZE)
    outcomes = list(follow(sample, network))
    assert problem(sample, outcomes) == "", outcomes


ADVICE = {
    "density, sigmoid": {"level": 0.5, "inside": "positive"},
    "density, 1 outside": {"level": 0.5, "inside": "negative"},
    "density, the inside given": {"level": 0.5, "inside": "positive"},
    "image of 8 bits": {"level": 127.5, "inside": "positive"},
    "CT, int16, of bone in air": {"level": 0.0, "inside": "positive"},
    "labels 0, 100, 117": {"label": 100},
    "labels 0, 1, 2, float32": {"label": 1},
    "labels 1, 2, 3": {"label": 2},
    "unsigned, of a ball": {"inside": "negative", "offset": 0.05},
    "exact, in voxels, spacing in mm": {"scale": 0.7},
    "exact, int16 in thousandths": {"scale": 0.001},
    "CSG of quadrics": {"field": "scaled"},
    "quadric": {"field": "scaled"},
    "level out of reach": {"level": 0.5, "inside": "positive"},
}


@pytest.mark.parametrize("name", ADVICE)
def test_the_way_out_is_the_one_option_that_helps(name):
    sample = KINDS[name](SIZE)
    options = {"spacing": np.array(sample.steps) * sample.unit, **sample.options}
    with pytest.raises(GridError) as caught:
        make_grid(sample.values, **options)
    assert advised(str(caught.value)) == ADVICE[name]


def test_the_spacing_of_each_axis_is_named_as_the_values_show_it():
    sample = KINDS["exact, slices 2.5 apart, one spacing given"](SIZE)
    with pytest.raises(GridError, match=r"\(they show --spacing ") as caught:
        make_grid(sample.values, spacing=0.05)
    found = advised(str(caught.value))["spacing"]
    assert found == pytest.approx([0.05, 0.05, 0.125], rel=0.02)
