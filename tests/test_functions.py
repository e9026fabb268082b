"""A function in, a mesh out: vertices lie where it is 0, and on its edges."""

import numpy as np
import pytest
from conftest import refusal, trilinear
from solids import box_distance

from super_sdf import DistanceFunction, reconstruct
from super_sdf.check import check_mesh
from super_sdf.errors import GridError, OptionError, OptionTypeError, SuperSdfWarning

H = 2 / 19
BOX = (-1.0, 1.0)
TURNED = np.linalg.qr(np.array([[1.0, 0.4, -0.3], [0.2, 1.0, 0.5], [-0.6, 0.1, 1.0]]))[0]
SIDES = np.array([0.55, 0.4, 0.45])


def torus(points):
    return np.hypot(np.hypot(*points[:, :2].T) - 0.55, points[:, 2]) - 0.25


def block(points):
    return box_distance(points @ TURNED, SIDES)


def off(function, mesh):
    """Return how far a mesh's vertices are from a surface, in voxels."""
    return np.abs(function(mesh.vertices.astype(np.float64))) / H


def is_on(function, mesh):
    """Whether vertices lie on a surface, but for a few that would have folded the mesh."""
    far = off(function, mesh)
    return np.quantile(far, 0.97) < 3e-5 and far.mean() < 5e-4


def test_vertices_lie_where_the_function_is_0():
    asked = DistanceFunction(torus)
    mesh = reconstruct(function=asked, bounds=BOX, spacing=H)
    plain = reconstruct(DistanceFunction(torus).sample(BOX, H))
    np.testing.assert_array_equal(mesh.faces, plain.faces)
    assert off(torus, plain).mean() > 1e-3
    assert is_on(torus, mesh)
    assert mesh.is_closed()
    assert 2 * len(mesh.vertices) <= asked.evaluations < 20**3 + 2.3 * len(mesh.vertices)


def test_edges_and_corners_are_those_of_the_function():
    plain = reconstruct(DistanceFunction(block).sample(BOX, H))
    mesh = reconstruct(function=block, bounds=BOX, spacing=H)
    ends = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * SIDES
    near, far = (
        np.linalg.norm(one.vertices[:, None] - ends @ TURNED.T, axis=2).min(0) / H
        for one in (mesh, plain)
    )
    assert np.median(near) < 1e-4 < 1e-2 < np.median(far)
    assert near.max() < 0.05
    assert 4 * off(block, mesh).mean() < off(block, plain).mean()
    assert mesh.is_closed()
    assert check_mesh(mesh, DistanceFunction(block).sample(BOX, H)).surface.faults() == []


@pytest.mark.parametrize("sign", [1, -1])
def test_any_function_that_changes_sign_there_will_do(sign):
    def occupancy(points):
        return sign * (0.5 - 1 / (1 + np.exp(-12 * torus(points))))[:, None]

    mesh = reconstruct(None, trilinear, function=occupancy, bounds=BOX, spacing=H)
    assert off(torus, mesh).mean() < 1e-4
    assert mesh.is_closed() and mesh.volume() > 0


def cubes(points, gap):
    """Two cubes apart, shifted along their walls."""
    middles = (-0.4 - gap / 2, 0, 0), (0.4 + gap / 2, 0.1, 0.2)
    return np.minimum(*(box_distance(points - middle, 0.4) for middle in middles))


THIN = {
    "shell of a block": lambda p: np.abs(block(p)) - 0.015,
    "shell of a torus": lambda p: np.abs(torus(p)) - 0.005,
    "two cubes": lambda p: cubes(p, 0.001),
}


@pytest.mark.parametrize("name", THIN)
@pytest.mark.parametrize("far", [0, 100])
def test_walls_that_nearly_touch_do_not_meet(name, far):
    def function(points):
        return THIN[name](points - [0, 0, far])

    bounds = (-1, -1, far - 1), (1, 1, far + 1)
    grid = DistanceFunction(function).sample(bounds, H)
    plain, mesh = reconstruct(grid), reconstruct(grid, function=function)
    assert check_mesh(mesh, grid).surface.faults() == check_mesh(plain, grid).surface.faults() == []
    assert off(function, mesh).mean() < 0.7 * off(function, plain).mean()


@pytest.mark.parametrize("sign", [1, -1])
def test_an_offset_is_where_the_function_has_it(sign):
    mesh = reconstruct(
        None, trilinear, function=lambda p: sign * torus(p), bounds=BOX, spacing=H, offset=0.1
    )
    assert is_on(lambda points: torus(points) - 0.1, mesh)


@pytest.mark.programs
@pytest.mark.parametrize("columns", [(), (1,)])
def test_a_module_of_pytorch_is_taken(columns):
    """It gets tensors of the type of its parameters; NumPy takes none that has gradients."""
    import torch

    class Ball(torch.nn.Linear):
        def forward(self, points):
            assert points.dtype == torch.float32 and not torch.is_grad_enabled()
            return (super().forward(points).norm(dim=1) - 0.6).reshape(-1, *columns)

    module = Ball(3, 3, bias=False)
    module.weight.data = torch.eye(3)
    mesh = reconstruct(None, trilinear, function=module, bounds=BOX, spacing=H)
    assert off(lambda points: np.linalg.norm(points, axis=1) - 0.6, mesh).max() < 1e-4
    assert (
        off(
            torus,
            reconstruct(
                None,
                trilinear,
                function=lambda p: torch.tensor(torus(p), dtype=torch.bfloat16, requires_grad=True),
                bounds=BOX,
                spacing=H,
            ),
        ).mean()
        < 0.05
    )


def test_vertices_that_do_not_reach_the_surface_are_counted():
    """The cube of a distance is 0 there, and so is its slope."""
    with pytest.warns(SuperSdfWarning, match=r"vertices did not reach the surface of the functi"):
        mesh = reconstruct(None, trilinear, function=lambda p: torus(p) ** 3, bounds=BOX, spacing=H)
    count = int(mesh.warnings[0].split(" of ")[0].replace(",", ""))
    assert 0.9 * count < (off(torus, mesh) > 0.0125).sum() < 1.1 * count


ASKED = {"function": torus, "bounds": BOX, "spacing": H}


@pytest.mark.parametrize(("arguments", "kind", "message"), [
    ({"function": 3}, OptionTypeError, "function is 3: give a function of points (n, 3)"),
    ({}, OptionTypeError, "grid is None: make one with make_grid(values, spacing=...) or "),
    ({"function": torus}, OptionError, "a function needs bounds and spacing, or a grid of its "),
    ({**ASKED, "bounds": (1, -1)}, OptionError, "bounds are (1, -1): give (lowest, highest), "),
    ({**ASKED, "function": lambda p: p}, OptionTypeError,
     "the function returns an array of shape (8, 3) for 8 points: return a real number for each"),
    ({**ASKED, "function": lambda p: np.full(len(p), np.nan)}, GridError,
     "the function has no finite value at any sample: give other bounds"),
    ({**ASKED, "function": lambda p: np.tanh(8 * torus(p)), "offset": 0.01}, OptionError,
     "offset is 0.01: the function is no distance, leave it out"),
    ({**ASKED, "function": lambda p: p[:, 0] + 9}, GridError,
     "the function goes from 8 to 10 at all 8,000 samples, and its surface is where it is 0: "),
])  # fmt: skip
def test_errors(arguments, kind, message):
    said = refusal(kind, reconstruct, network=trilinear, **arguments)
    assert said.startswith(message), said


def test_a_function_of_another_grid_is_refused():
    grid = DistanceFunction(torus).sample(BOX, H)
    said = refusal(OptionError, reconstruct, grid, trilinear, function=block)
    assert said.startswith("function has another side than the grid at ")
    assert said.endswith("give the function that the grid has samples of")
