"""Every refusal's way out is tried, on a zoo of grids as people have them."""

import pytest

from lab.zoo import KINDS, follow, problem
from super_sdf import load_network

SIZE = 24


@pytest.fixture(scope="module")
def network():
    return load_network("base", threads=1)


@pytest.mark.parametrize("name", KINDS)
def test_a_mesh_is_no_worse_than_marching_cubes_or_refused_with_a_way_there(name, network):
    sample = KINDS[name](SIZE)
    outcomes = list(follow(sample, network))
    assert problem(sample, outcomes) == "", outcomes
