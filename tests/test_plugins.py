"""The plugins in their programs where those are installed, as by .ci/nightly, else in stand-ins."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista
import trimesh
from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase

from super_sdf import grid_from_image, reconstruct, reconstruct_labels

ROOT = Path(__file__).parent.parent / "plugins"
FILES = {
    "paraview": "super_sdf_paraview.py",
    "blender": "__init__.py",
    "slicer": "SuperSdf/SuperSdf.py",
    "napari": "napari_super_sdf/__init__.py",
}
PROGRAMS = [
    pytest.param(name, marks=pytest.mark.programs if name == "blender" else ()) for name in FILES
]
LABELS = np.zeros((14, 16, 18), np.uint8)
LABELS[3:11, 3:9, 4:14], LABELS[3:11, 9:13, 4:12] = 1, 2
BALL = pyvista.ImageData(dimensions=(16, 17, 18), spacing=(0.5,) * 3, origin=(1, 2, 3))
BALL["distance"] = np.linalg.norm(BALL.points - BALL.center - 0.1, axis=1) - 2.6
PLACE = {"scale": np.array((2, 1, 0.5)), "translate": np.array((5, 6, 7))}


@pytest.fixture
def load(monkeypatch):
    """Return a function that runs a plugin beside stand-ins of programs that are not installed."""
    same = SimpleNamespace(
        **dict.fromkeys(("xml", "filter", "input", "datatype"), lambda *_, **__: lambda kind: kind)
    )
    decorators = dict.fromkeys(("smdomain", "smproperty", "smproxy"), same)
    algorithm = SimpleNamespace(VTKPythonAlgorithmBase=VTKPythonAlgorithmBase, **decorators)
    kinds = [f"ScriptedLoadableModule{end}" for end in ("", "Logic", "Widget")]
    stand_ins = {
        "paraview": {"paraview.util.vtkAlgorithm": algorithm},
        "slicer": {
            "slicer.ScriptedLoadableModule": SimpleNamespace(**dict.fromkeys(kinds, object))
        },
        "napari": {"napari.utils": MagicMock()},
    }

    def run(program: str) -> SimpleNamespace:
        is_here = program == "napari" and "napari" in sys.modules
        for name, module in {} if is_here else stand_ins.get(program, {}).items():
            for parent in ("qt", "paraview", "paraview.util", "slicer", "napari"):
                monkeypatch.setitem(sys.modules, parent, MagicMock())
            monkeypatch.setitem(sys.modules, name, module)
        return SimpleNamespace(**runpy.run_path(str(ROOT / program / FILES[program])))

    return run


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_plugin_is_short_and_says_how_super_sdf_is_installed(program, load, monkeypatch, caplog):
    assert len((ROOT / program / FILES[program]).read_text().splitlines()) <= 150
    plugin, blender = load(program), MagicMock()
    monkeypatch.setitem(sys.modules, "super_sdf", None)
    assert plugin.MISSING.startswith("super-sdf is not installed") and "\n" not in plugin.MISSING
    if program == "paraview":
        made = plugin.SuperSdfFilter()
        made.SetInputDataObject(BALL)
        made.Update()
        assert plugin.MISSING in caplog.text
    elif program == "blender":
        assert plugin.ImportGrid.execute(blender, None) == {"CANCELLED"}
        blender.report.assert_called_once_with({"ERROR"}, plugin.MISSING)
    else:
        napari = program == "napari"
        with pytest.raises(ModuleNotFoundError) as error:
            plugin.labels_to_surfaces(None) if napari else plugin.smooth_meshes(LABELS, np.eye(4))
        assert str(error.value) == plugin.MISSING


def test_paraview_makes_the_mesh_of_the_library(load, caplog):
    plugin, mesh = load("paraview"), reconstruct(grid_from_image(BALL))
    made = plugin.SuperSdfFilter()
    made.SetInputDataObject(BALL)
    properties = ElementTree.fromstring(f"<all>{plugin.PROPERTIES}</all>")
    assert all(callable(getattr(made, each.get("command"))) for each in properties)
    made.Update()
    surface = pyvista.wrap(made.GetOutputDataObject(0))
    assert surface.points.tobytes() == mesh.vertices.tobytes()
    assert np.array_equal(surface.regular_faces, mesh.faces)
    made.SetFactor(2)
    made.SetSimplify(0.05)
    made.Update()
    assert 0 < made.GetOutputDataObject(0).GetNumberOfCells() < len(mesh.faces) / 8
    made.SetField("density")
    made.SetLevel(99)
    made.Update()
    assert not made.GetOutputDataObject(0).GetNumberOfCells()
    assert "super-sdf: no value is above 99" in caplog.text


def test_slicer_gets_closed_segments_where_the_labels_are(load):
    plugin = load("slicer")
    to_ras = np.array([[0, -2, 0, 50], [0, 0, 1, -20], [0.5, 0, 0, 7], [0, 0, 0, 1]], float)
    sys.modules["slicer"].util.arrayFromVolume = lambda node: LABELS.transpose()
    sys.modules["slicer"].util.arrayFromVTKMatrix = lambda matrix: to_ras
    given = MagicMock()
    given.GetSegmentation().GetNthSegment = lambda at: SimpleNamespace(
        GetName=lambda: f"segment {at}", GetColor=lambda: (at, 1, 0)
    )
    made = plugin.SuperSdfLogic().run(given, keep_volume=True)
    calls = [call.args for call in made.AddSegmentFromClosedSurfaceRepresentation.call_args_list]
    assert [call[1:] for call in calls] == [("segment 0", (0, 1, 0)), ("segment 1", (1, 1, 0))]
    for label, (surface, *_) in enumerate(calls, start=1):
        points, faces = pyvista.wrap(surface).points, pyvista.wrap(surface).regular_faces
        found, voxels = trimesh.Trimesh(points, faces), np.argwhere(label == LABELS)
        assert found.is_watertight
        assert found.volume == pytest.approx(len(voxels), rel=0.02)  # a voxel has the volume 1
        centre = to_ras[:3, :3] @ voxels.mean(0) + to_ras[:3, 3]
        assert np.allclose(found.center_mass, centre, atol=0.15)
    with pytest.raises(ValueError, match="no segmentation is chosen"):
        plugin.SuperSdfLogic().run(None)


def test_napari_gets_surfaces_in_the_place_of_their_layer(load):
    plugin = load("napari")
    layer = SimpleNamespace(name="organs", multiscale=False, data=LABELS, **PLACE)
    layer.get_color = lambda label: np.array((1, label / 2, 0, 1))
    meshes = reconstruct_labels(LABELS, spacing=layer.scale)
    for label, made in enumerate(plugin.labels_to_surfaces(layer), start=1):
        (vertices, faces), more, kind = made
        assert np.array_equal(faces, meshes[label].faces) and kind == "surface"
        assert np.allclose(vertices * more["scale"], meshes[label].vertices)
        assert more["name"] == f"organs {label}" and more["translate"] is layer.translate
        assert (more["vertex_colors"] == (1, label / 2, 0, 1)).all()
    layer.data = (LABELS > 0).astype(np.float32)
    (((vertices, faces), *_),) = plugin.image_to_surface(layer, field="mask", factor="4")
    (((_, few), *_),) = plugin.image_to_surface(layer, field="density", level=0.5, simplify=0.1)
    assert np.allclose(vertices.mean(0), np.argwhere(LABELS).mean(0), atol=0.5)
    assert 0 < len(few) < len(faces)


@pytest.mark.programs
def test_napari_takes_the_manifest_and_the_layers(load):
    import napari.layers as layers
    import npe2

    manifest = ROOT / "napari" / "napari_super_sdf" / "napari.yaml"
    found = npe2.PluginManifest.from_file(manifest)
    assert len(found.contributions.widgets) == 2
    made = load("napari").labels_to_surfaces(layers.Labels(LABELS, **PLACE))[0]
    points = made[0][0] * PLACE["scale"] + PLACE["translate"]
    extent = layers.Layer.create(*made).extent.world
    assert np.allclose(extent, (points.min(0), points.max(0)), atol=1e-3)


@pytest.mark.programs
def test_blender_imports_a_mesh_object(load, tmp_path):
    import bpy

    plugin, mesh, path = load("blender"), reconstruct(grid_from_image(BALL)), tmp_path / "ball.vti"
    BALL.save(path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    plugin.register()
    assert bpy.ops.import_mesh.super_sdf(filepath=str(path), scale=0.001) == {"FINISHED"}
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.import_mesh.super_sdf(filepath="none.npy")
    plugin.unregister()
    data, scale = bpy.context.object.data, bpy.context.object.scale
    assert np.array_equal([vertex.co for vertex in data.vertices], mesh.vertices)
    assert len(data.polygons) == len(mesh.faces) and scale[0] == np.float32(0.001)
