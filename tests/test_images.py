"""VTK image data in memory, and PyVista's accessor: the grid and the mesh of the same .vti file."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista
from conftest import refusal, trilinear
from vtkmodules.vtkCommonDataModel import vtkImageData

from super_sdf import grid_from_image, read_grid, reconstruct
from super_sdf.errors import FileError, GridError, OptionTypeError

ROOT = Path(__file__).parent.parent
SIZES = 20, 22, 24
RADIUS = 4.2
UNIT = "they are distances in another unit than the spacing: multiply the values, scale=0.4 (or "
TURNED = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
DIRECTIONS = {
    "straight": np.eye(3),
    "swapped": np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]]),
    "mirrored": np.diag([-1, 1, 1]),
    "turned": TURNED,
    "turned and mirrored": TURNED[:, [1, 0, 2]],
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
