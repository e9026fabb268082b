"""ParaView: the filter "super-sdf" makes fine, closed surfaces of image data.

Tools > Manage Plugins > Load New takes this file; the filter is then in Filters > Alphabetical.
docs/guides/plugins.md says how ParaView's Python finds super-sdf.
"""

import sys

import numpy as np
from paraview.util.vtkAlgorithm import VTKPythonAlgorithmBase, smdomain, smproperty, smproxy
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkDataObject, vtkImageData, vtkPolyData

MISSING = (
    "super-sdf is not installed: run 'pip install /path/to/super-sdf' in an environment of Python "
    f"{sys.version_info[0]}.{sys.version_info[1]}, and start ParaView with the environment's "
    "site-packages folder in PYTHONPATH"
)
PROPERTIES = """
<StringVectorProperty name="Scalars" command="SetInputArrayToProcess" number_of_elements="5"
    element_types="0 0 0 0 2">
  <ArrayListDomain name="array_list" attribute_type="Scalars" input_domain_name="array">
    <RequiredProperties><Property name="Input" function="Input"/></RequiredProperties>
  </ArrayListDomain>
  <Documentation>Distances, a mask or densities, at points or in cells.</Documentation>
</StringVectorProperty>
<IntVectorProperty name="Factor" command="SetFactor" number_of_elements="1" default_values="0">
  <EnumerationDomain name="enum">
    <Entry value="0" text="automatic"/>
    <Entry value="2" text="2"/>
    <Entry value="4" text="4"/>
    <Entry value="8" text="8"/>
    <Entry value="16" text="16"/>
  </EnumerationDomain>
  <Documentation>Fine voxels per voxel; automatic is 2 for masks, else 4.</Documentation>
</IntVectorProperty>
<StringVectorProperty name="Field" command="SetField" number_of_elements="1" default_values="auto">
  <StringListDomain name="list">
    <String value="auto"/>
    <String value="distance"/>
    <String value="noisy"/>
    <String value="mask"/>
    <String value="smooth"/>
    <String value="density"/>
  </StringListDomain>
  <Documentation>Kind of the values: auto recognises it, density needs a level.</Documentation>
</StringVectorProperty>
<DoubleVectorProperty name="Level" command="SetLevel" number_of_elements="1" default_values="0">
  <Documentation>Density at the surface; larger values are inside.</Documentation>
  <Hints>
    <PropertyWidgetDecorator type="GenericDecorator" mode="visibility" property="Field"
        value="density"/>
  </Hints>
</DoubleVectorProperty>
<DoubleVectorProperty name="Simplify" command="SetSimplify" number_of_elements="1"
    default_values="0">
  <DoubleRangeDomain name="range" min="0"/>
  <Documentation>Largest error of simplifying, in voxels (0.02); 0 keeps all.</Documentation>
</DoubleVectorProperty>"""


@smproxy.filter(name="supersdf", label="super-sdf")
@smproperty.xml(PROPERTIES)
@smproperty.input(name="Input")
@smdomain.xml('<InputArrayDomain name="array" number_of_components="1" optional="1"/>')
@smdomain.datatype(dataTypes=["vtkImageData"], composite_data_supported=False)
class SuperSdfFilter(VTKPythonAlgorithmBase):
    """The fine, closed surface of the solid that image data describes, as triangles."""

    def __init__(self):
        super().__init__(inputType="vtkImageData", outputType="vtkPolyData")
        self.factor, self.field, self.level, self.simplify = 0, "auto", 0.0, 0.0

    def SetFactor(self, value):  # noqa: N802
        """Set how many times finer than the image; 0: automatic."""
        self._set("factor", value)

    def SetField(self, value):  # noqa: N802
        """Set what the values are."""
        self._set("field", value)

    def SetLevel(self, value):  # noqa: N802
        """Set the density at the surface, for the field "density"."""
        self._set("level", value)

    def SetSimplify(self, value):  # noqa: N802
        """Set within how many voxels triangles are spared; 0: none."""
        self._set("simplify", value)

    def _set(self, name, value):
        """Keep a property; the surface is made anew if its value changed."""
        if getattr(self, name) != value:
            setattr(self, name, value)
            self.Modified()

    def RequestData(self, request, inputs, outputs):  # noqa: N802
        """Make the surface; what is wrong is shown in Output Messages."""
        image, surface = vtkImageData.GetData(inputs[0]), vtkPolyData.GetData(outputs)
        try:
            from super_sdf import SuperSdfError
        except ModuleNotFoundError:
            return self._fail(MISSING)
        try:
            mesh = self._mesh_of(image)
        except SuperSdfError as error:
            return self._fail(f"super-sdf: {error}")
        points, triangles = vtkPoints(), vtkCellArray()
        points.SetData(numpy_to_vtk(mesh.vertices, deep=True))
        corners = numpy_to_vtkIdTypeArray(mesh.faces.ravel().astype(np.int64), deep=True)
        triangles.SetData(3, corners)
        surface.SetPoints(points)
        surface.SetPolys(triangles)
        return 1

    def _mesh_of(self, image):
        """Return the refined mesh of an image."""
        from super_sdf import grid_from_image, reconstruct, simplify_mesh

        chosen = self.GetInputArrayInformation(0).Get(vtkDataObject.FIELD_NAME())
        kind = {"level": self.level} if self.field == "density" else {"field": self.field}
        grid = grid_from_image(image, chosen or None, **kind)
        for note in grid.notes:
            print(f"super-sdf: {note}")
        mesh = reconstruct(grid, factor=self.factor or None, progress=self._show)
        if self.simplify:
            return simplify_mesh(mesh, error=self.simplify * grid.voxel_size)
        return mesh

    def _show(self, done, total):
        """Move ParaView's bar."""
        self.UpdateProgress(done / total)

    def _fail(self, why):
        """Show an error; the surface stays empty."""
        vtkOutputWindow.GetInstance().DisplayErrorText(f"{why}\n")
        return 1
