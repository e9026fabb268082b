"""The recipes for Blender and ParaView as far as they run without either, and their page."""

import re
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import pyvista
from vtkmodules.vtkCommonDataModel import vtkPolyData

from super_sdf import read_grid, reconstruct
from super_sdf.truth import read_mesh

ROOT = Path(__file__).parent.parent
TOOLS = ROOT / "examples" / "tools"
PAGE = (ROOT / "docs" / "guides" / "tools.md").read_text()


@pytest.fixture(scope="module")
def field(tmp_path_factory) -> Path:
    """Return the path of an image of a ball."""
    image = pyvista.ImageData(dimensions=(16, 17, 18), spacing=(0.5,) * 3, origin=(1, 2, 3))
    image["distance"] = np.linalg.norm(image.points - image.center - 0.1, axis=1) - 2.6
    image.save(path := tmp_path_factory.mktemp("field") / "ball.vti")
    return path


@pytest.fixture(scope="module")
def mesh(field):
    """Return the mesh of the ball that the library makes."""
    return reconstruct(read_grid(field))


def recipe(name: str, **given: object) -> dict:
    """Return what a recipe defines, run with some global names."""
    return runpy.run_path(str(TOOLS / f"{name}.py"), given)


def test_the_programmable_filter_makes_the_mesh_of_the_library(field, mesh):
    image, made = pyvista.read(field), vtkPolyData()
    inputs = [SimpleNamespace(VTKObject=image)]  # as ParaView hands them to the script
    recipe("paraview_filter", inputs=inputs, output=SimpleNamespace(VTKObject=made))
    surface = pyvista.wrap(made)
    assert surface.points.tobytes() == mesh.vertices.tobytes()
    assert np.array_equal(surface.regular_faces, mesh.faces)


def test_blender_gets_the_same_mesh_from_the_library_and_from_the_command(
    field, mesh, tmp_path, monkeypatch
):
    recipes = recipe("blender_import")
    vertices, faces = recipes["refine"](field)
    monkeypatch.setenv("SUPER_SDF", str(Path(sys.executable).with_name("super-sdf")))
    recipes["run_command"](field, tmp_path / "ball.ply")
    written = read_mesh(tmp_path / "ball.ply")
    for other in (vertices, written.vertices.astype(np.float32)):
        assert other.tobytes() == mesh.vertices.tobytes()
    assert np.array_equal(faces, mesh.faces) and np.array_equal(written.faces, mesh.faces)


def test_the_python_on_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with_pyvista, with_xarray = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    names: dict = {}
    exec(compile(with_pyvista, "tools.md", "exec"), names)
    points = pyvista.read("ball.ply").points - names["image"].center
    assert np.abs(np.linalg.norm(points, axis=1) - 1.2).max() < 0.01
    exec(compile(with_xarray, "tools.md", "exec"), names)
    points = names["mesh"].vertices - (12, 0, 0)
    assert np.abs(np.linalg.norm(points, axis=1) - 1.5).max() < 0.02
