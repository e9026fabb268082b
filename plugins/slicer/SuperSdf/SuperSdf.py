"""3D Slicer: the module "super-sdf" makes smooth, closed surfaces of a segmentation.

It is a scripted module for Slicer 5.2 and later; docs/guides/plugins.md says how it and super-sdf
are installed.
"""

import numpy as np
import qt
import slicer
import vtk
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleWidget,
)
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

MISSING = (
    "super-sdf is not installed in Slicer's Python: run "
    "slicer.util.pip_install('/path/to/super-sdf') in Slicer's Python console"
)


class SuperSdf(ScriptedLoadableModule):
    """What Slicer's list of modules says."""

    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "super-sdf"
        parent.categories = ["Segmentation"]
        parent.contributors = ["the authors of super-sdf"]
        parent.helpText = (
            "Makes a segmentation of smooth, closed surfaces. Neighbouring segments share their "
            "walls. Where segments overlap, the last segment is taken."
        )


class SuperSdfWidget(ScriptedLoadableModuleWidget):
    """The panel: a segmentation, a factor, and a button."""

    def setup(self):
        """Build the panel."""
        super().setup()
        form = qt.QFormLayout()
        self.layout.addLayout(form)
        self.selector = slicer.qMRMLNodeComboBox()
        self.selector.nodeTypes = ["vtkMRMLSegmentationNode"]
        self.selector.addEnabled = self.selector.removeEnabled = False
        self.selector.setMRMLScene(slicer.mrmlScene)
        form.addRow("Segmentation", self.selector)
        self.factor = qt.QComboBox()
        self.factor.addItems(["2", "4", "8"])
        self.factor.setToolTip("Times finer than the segmentation")
        form.addRow("Factor", self.factor)
        self.keep_volume = qt.QCheckBox()
        self.keep_volume.setToolTip("Give each surface the volume of its voxels")
        form.addRow("Keep volumes", self.keep_volume)
        self.button = qt.QPushButton("Make smooth surfaces")
        self.button.connect("clicked(bool)", self.on_clicked)
        self.layout.addWidget(self.button)
        self.layout.addStretch(1)

    def on_clicked(self, _checked=False):
        """Make the surfaces; what is wrong is shown in a window."""
        with slicer.util.tryWithErrorDisplay("No surfaces were made.", waitCursor=True):
            SuperSdfLogic().run(
                self.selector.currentNode(),
                int(self.factor.currentText),
                keep_volume=self.keep_volume.checked,
            )


class SuperSdfLogic(ScriptedLoadableModuleLogic):
    """A segmentation in, a segmentation of closed surfaces out."""

    def run(self, segmentation, factor=2, keep_volume=False):
        """Add a segmentation with the surface of each segment to the scene, and return it."""
        if segmentation is None:
            raise ValueError("no segmentation is chosen: load or make one first")
        meshes = self.meshes_of(segmentation, factor, keep_volume)
        name = f"{segmentation.GetName()} smooth"
        made = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", name)
        made.SetSourceRepresentationToClosedSurface()
        made.CreateDefaultDisplayNodes()
        if segmentation.GetTransformNodeID():
            made.SetAndObserveTransformNodeID(segmentation.GetTransformNodeID())
        for label, mesh in meshes.items():
            # Slicer exports the n-th segment as the label n, counted from 1.
            segment = segmentation.GetSegmentation().GetNthSegment(label - 1)
            made.AddSegmentFromClosedSurfaceRepresentation(
                polygons(mesh), segment.GetName(), segment.GetColor()
            )
        return made

    def meshes_of(self, segmentation, factor, keep_volume):
        """Return the meshes of all segments by their number, in the segmentation's RAS space."""
        image = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode")
        try:
            extent = slicer.vtkSegmentation.EXTENT_REFERENCE_GEOMETRY
            export = slicer.modules.segmentations.logic().ExportAllSegmentsToLabelmapNode
            if not export(segmentation, image, extent):
                raise RuntimeError("Slicer cannot export the segmentation as a labelmap")
            to_ras = vtk.vtkMatrix4x4()
            image.GetIJKToRASMatrix(to_ras)
            return smooth_meshes(
                slicer.util.arrayFromVolume(image),
                slicer.util.arrayFromVTKMatrix(to_ras),
                factor=factor,
                keep_volume=keep_volume,
            )
        finally:
            if image.GetDisplayNode():
                slicer.mrmlScene.RemoveNode(image.GetDisplayNode().GetColorNode())
            slicer.mrmlScene.RemoveNode(image)


def smooth_meshes(labels, to_ras, **options):
    """Return the mesh of each label of an array (k, j, i), with the matrix from i, j, k to RAS."""
    try:
        from super_sdf import reconstruct_labels
    except ModuleNotFoundError:
        raise ModuleNotFoundError(MISSING) from None
    columns = np.asarray(to_ras, dtype=np.float64)[:3]
    spacing = np.linalg.norm(columns[:, :3], axis=0)
    place = {"origin": columns[:, 3], "direction": columns[:, :3] / spacing}
    return reconstruct_labels(np.transpose(labels), spacing=spacing, **place, **options)


def polygons(mesh):
    """Return a mesh as ``vtkPolyData``."""
    points, triangles, surface = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
    points.SetData(numpy_to_vtk(mesh.vertices, deep=True))
    corners = numpy_to_vtkIdTypeArray(mesh.faces.ravel().astype(np.int64), deep=True)
    triangles.SetData(3, corners)
    surface.SetPoints(points)
    surface.SetPolys(triangles)
    return surface
