"""A function, an image or a script's array in, a mesh out: on their surfaces and their edges."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista
from conftest import refusal, trilinear
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes as of_skimage
from solids import box_distance
from vtkmodules.vtkCommonDataModel import vtkImageData

from super_sdf import DistanceFunction, grid_from_image, marching_cubes, read_grid, reconstruct
from super_sdf.check import examine_surface
from super_sdf.errors import FileError, GridError, OptionError, OptionTypeError, SuperSdfWarning

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
    assert np.count_nonzero(near < 1e-4) >= 4 and np.median(far) > 1e-2
    assert near.max() < 0.15  # where the field has no corner, none is looked for
    assert 4 * off(block, mesh).mean() < off(block, plain).mean()
    assert mesh.is_closed()
    assert examine_surface(mesh).faults() == []


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


@pytest.mark.parametrize(
    ("name", "far"), [("shell of a torus", 0), *((each, 100) for each in THIN)]
)
def test_walls_that_nearly_touch_do_not_meet(name, far):
    def function(points):
        return THIN[name](points - [0, 0, far])

    bounds = (-1, -1, far - 1), (1, 1, far + 1)
    grid = DistanceFunction(function).sample(bounds, H)
    plain, mesh = reconstruct(grid), reconstruct(grid, function=function)
    assert examine_surface(mesh).faults() == examine_surface(plain).faults() == []
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


@pytest.mark.programs
def test_tensors_with_gradients_and_half_the_digits_are_taken():
    import torch

    def values(points):
        return torch.tensor(torus(points), dtype=torch.bfloat16, requires_grad=True)

    mesh = reconstruct(None, trilinear, function=values, bounds=BOX, spacing=H)
    assert off(torus, mesh).mean() < 0.05


def test_vertices_that_do_not_reach_the_surface_are_counted():
    """The cube of a distance is 0 there, and so is its slope."""
    with pytest.warns(SuperSdfWarning, match=r"vertices did not reach the surface of the functi"):
        mesh = reconstruct(function=lambda p: torus(p) ** 3, bounds=BOX, spacing=2 * H, factor=2)
    count = int(mesh.warnings[0].split(" of ")[0].replace(",", ""))
    assert 0.9 * count < (off(torus, mesh) > 0.05).sum() < 1.1 * count


ASKED = {"function": torus, "bounds": BOX, "spacing": H}


@pytest.mark.parametrize(("arguments", "kind", "message"), [
    ({"function": 3}, OptionTypeError, "function is 3: give a function of points (n, 3)"),
    ({}, OptionTypeError, "grid is None: make one with make_grid(values, spacing=...) or "),
    ({"function": torus}, OptionError, "a function needs bounds and spacing, or a grid of its "),
    ({"grid": DistanceFunction(torus).sample(BOX, H), "function": block}, OptionError,
     "function has another side than the grid at "),
    ({**ASKED, "level": 0.1}, OptionError, "level is for arrays: a grid or function has its own"),
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


# Marching cubes beside scikit-image's: scripts in which only the import is changed


PLACES = np.indices((24, 22, 26)).astype(np.float32)
MIDDLE = np.array([11.3, 10.2, 12.6])
BALL = np.linalg.norm(PLACES - MIDDLE[:, None, None, None], axis=0) - 7.1

LEVEL_SET = """
from skimage.draw import ellipsoid
from {home} import marching_cubes

volume = ellipsoid(6, 10, 16, levelset=True)
verts, faces, normals, values = marching_cubes(volume, 0)
corners = verts[faces]
assert len(normals) == len(values) == len(verts) and values.max() > 0
"""
NEURAL_FIELD = """
import numpy as np
import torch
from {home} import marching_cubes

n, bound = 32, 1.1
axis = torch.linspace(-bound, bound, n)
points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
sdf = (points.norm(dim=1) - 0.8).reshape(n, n, n).numpy()
voxel = 2 * bound / (n - 1)
verts, faces, normals, _ = marching_cubes(sdf, level=0.0, spacing=[voxel] * 3)
verts = verts - bound
assert abs(np.linalg.norm(verts, axis=1) - 0.8).max() < 0.01
assert ((normals * verts).sum(1) < 0).all()
corners = verts[faces]
"""
SCAN = """
import numpy as np
import trimesh
from {home} import marching_cubes

x, y, z = np.mgrid[-12:13, -14:15, -9:10]
scan = (1000 / (1 + np.exp(np.hypot(np.hypot(x, y) - 7, 1.6 * z) - 4)) - 150).astype(np.int16)
verts, faces, normals, _ = marching_cubes(
    scan, 350, spacing=(0.7, 0.7, 1.5), step_size=1, allow_degenerate=False
)
mesh = trimesh.Trimesh(verts, faces, vertex_normals=normals)
assert mesh.is_watertight and mesh.euler_number == 0
corners = mesh.triangles
"""


@pytest.mark.parametrize(
    "script", [LEVEL_SET, pytest.param(NEURAL_FIELD, marks=pytest.mark.programs), SCAN]
)
def test_only_the_import_changes(script):
    volumes = []
    for home in ("skimage.measure", "super_sdf"):
        names = {}
        exec(script.format(home=home), names)
        a, b, c = np.moveaxis(names["corners"].astype(np.float64), 1, 0)
        volumes.append(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
    assert volumes[1] == pytest.approx(volumes[0], rel=0.03)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("way", ["descent", "ascent"])
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.1, 0.2, 0.3)])
def test_vertices_winding_and_normals_are_as_there(sign, way, spacing):
    how = {"spacing": spacing, "gradient_direction": way}
    wanted = of_skimage(sign * BALL, 0.5, **how)
    found = marching_cubes(sign * BALL, 0.5, network=trilinear, factor=2, **how)
    assert [a.dtype.kind for a in found] == [a.dtype.kind for a in wanted]
    near = cKDTree(found[0]).query(wanted[0])[0]
    assert near.max() < 0.4 * max(spacing)
    sides = []
    for vertices, faces, normals, _ in (found, wanted):
        a, b, c = vertices[faces].transpose(1, 0, 2)
        outward = (a + b + c) / 3 - MIDDLE * spacing
        sides.append((np.einsum("ni,ni->n", outward, np.cross(b - a, c - a)) > 0).mean())
        assert (
            np.sign(sign * np.einsum("ni,ni->n", normals, vertices - MIDDLE * spacing)) < 0
        ).all()
    assert sides[0] == sides[1] in (0, 1)
    assert np.median(found[3]) == pytest.approx(np.median(wanted[3]), rel=0.1)


def test_without_a_level_it_is_half_way_as_there():
    values = np.clip(BALL, -3, 5)
    wanted, found = of_skimage(values)[0], marching_cubes(values, network=trilinear)[0]
    for vertices in (wanted, found):
        assert np.linalg.norm(vertices - MIDDLE, axis=1).mean() == pytest.approx(8.1, abs=0.03)


@pytest.mark.parametrize(("wrong", "said"), [
    ({"level": 99}, "level is 99: give one within the values, "),
    ({"level": "one"}, "level is 'one': give a finite number"),
    ({"step_size": 2}, "step_size is 2: all samples are refined, leave it out"),
    ({"mask": BALL > 0}, "mask is given: all samples are refined, leave it out"),
    ({"method": "dual"}, "method is 'dual': give one of lewiner, lorensen"),
])  # fmt: skip
def test_what_is_not_taken_is_said(wrong, said):
    assert refusal(OptionError, marching_cubes, BALL, **{"level": 0, **wrong}).startswith(said)


# VTK image data in memory, and PyVista's accessor: the grid and the mesh of the same .vti file


ROOT = Path(__file__).parent.parent
SIZES = 20, 22, 24
RADIUS = 4.2
UNIT = "the distances have another unit than the spacing: multiply the values, scale=0.4 (or "
ABOUT_Z = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
DIRECTIONS = {
    "straight": np.eye(3),
    "swapped": np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]]),
    "mirrored": np.diag([-1, 1, 1]),
    "turned": ABOUT_Z,
    "turned and mirrored": ABOUT_Z[:, [1, 0, 2]],
}


def sphere(direction: str = "straight", start: tuple[int, int, int] = (0, 0, 0)):
    """Return an image of a sphere's distances, float32, and the centre of the sphere."""
    ends = [s + n - 1 for s, n in zip(start, SIZES)]
    image = pyvista.ImageData(spacing=(0.5, 0.5, 0.5), origin=(10, -20, 30))
    image.extent = [end for pair in zip(start, ends) for end in pair]
    image.direction_matrix = DIRECTIONS[direction]
    centre = image.points.mean(0) + 0.13
    away = np.linalg.norm(image.points - centre, axis=1)
    image.point_data["distance"] = (away - RADIUS).astype(np.float32)
    return image, centre


def in_cells(image: pyvista.ImageData, centre: np.ndarray) -> pyvista.ImageData:
    """Return the same lattice with the distances of its cells' centres."""
    image = image.copy()
    image.clear_data()
    away = np.linalg.norm(image.cell_centers().points - centre, axis=1)
    image.cell_data["distance"] = (away - RADIUS).astype(np.float32)
    return image


@pytest.mark.parametrize(
    "direction, where",
    [*((direction, "points") for direction in DIRECTIONS), ("turned and mirrored", "cells")],
)
def test_the_surface_is_the_one_of_the_file(direction, where, folder):
    image, centre = sphere(direction, (3, -2, 7))
    image = in_cells(image, centre) if where == "cells" else image
    image.save("image.vti")
    grid = read_grid("image.vti")
    assert repr(image.super_sdf.grid()) == repr(grid) == repr(grid_from_image(image))
    assert np.array_equal(image.super_sdf.grid().values, grid.values)
    mesh = reconstruct(grid, trilinear, 2)
    surface = image.super_sdf.contour(2, network=trilinear)
    assert surface.points.tobytes() == mesh.vertices.tobytes()
    assert surface.points.dtype == mesh.vertices.dtype
    assert np.array_equal(surface.regular_faces, mesh.faces)


def test_residuals_are_those_of_the_certificate():
    image, _ = sphere()
    surface = image.super_sdf.contour(2, residuals=True)
    residuals = surface.point_data["residual"]
    assert residuals.dtype == np.float32 and len(residuals) == surface.n_points
    assert np.nanmax(np.abs(residuals)) < 0.05
    moved = image.super_sdf.contour(2, residuals=True, offset=0.5)
    assert np.nanmax(np.abs(moved.point_data["residual"])) < 0.05  # of the offset, too


def test_the_active_scalars_are_taken_or_those_with_a_name():
    image, centre = sphere()
    image.point_data["larger"] = image.point_data["distance"] - 0.5
    lowest = image.super_sdf.grid().low
    assert image.super_sdf.grid("larger").low == pytest.approx(lowest - 0.5)
    image.set_active_scalars("larger")
    assert image.super_sdf.grid().low == pytest.approx(lowest - 0.5)
    image.cell_data["of cells"] = in_cells(image, centre).cell_data["distance"]
    assert image.super_sdf.grid("of cells").shape == tuple(n - 1 for n in SIZES)


def test_other_mistakes_are_one_line():
    image, _ = sphere()
    contour = image.super_sdf.contour
    image.point_data["vectors"] = np.zeros((image.n_points, 3))
    for kind, call, said in (
        (OptionTypeError, lambda: grid_from_image([1]), "image is [1]: give VTK image data"),
        (FileError, lambda: grid_from_image(vtkImageData()), "the image holds no array of points "),
        (FileError, lambda: contour(scalars="b"), "the image has no array of points or cells 'b'"),
        (GridError, lambda: contour(scalars="vectors"), "its array 'vectors' has 3 "),
    ):
        assert refusal(kind, call).startswith(said)
    image.spacing = (0.2, 0.2, 0.2)
    assert refusal(GridError, contour).startswith(UNIT)


def test_pyvista_finds_the_accessor_and_super_sdf_does_not_load_pyvista():
    script = (
        "import sys, super_sdf\n"
        "super_sdf.make_grid, super_sdf.reconstruct, super_sdf.grid_from_image\n"
        "assert not {'pyvista', 'vtkmodules', 'super_sdf.functions.pyvista'} & set(sys.modules)\n"
        "import pyvista\n"
        "assert 'super_sdf.functions.pyvista' not in sys.modules\n"
        "print(pyvista.ImageData().super_sdf, hasattr(pyvista.PolyData(), 'super_sdf'))"
    )
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
    assert done.stdout.startswith(b"<super_sdf.functions.pyvista.ImageAccessor object at ")
    assert done.stdout.endswith(b" False\n")
