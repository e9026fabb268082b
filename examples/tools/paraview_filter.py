"""ParaView: the refined surface of image data, as a Programmable Filter.

Paste this file into a Programmable Filter whose Output Data Set Type is vtkPolyData.
docs/guides/tools.md says how ParaView finds super-sdf; paraview_render.py does it all without a
window.
"""

FACTOR = 4  # times finer than the image: 2, 4, 8 or 16
SCALARS = None  # the name of the array; None for the active one
MESHER = "auto"  # "marching" takes less time, and cuts off edges and corners


def fill_surface(image, surface, scalars=None, factor=4, **options):
    """Make a ``vtkPolyData`` the surface of the solid that a ``vtkImageData`` describes."""
    import numpy as np
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    from super_sdf import grid_from_image, reconstruct

    grid = grid_from_image(image, scalars)
    for note in grid.notes:
        print(f"super-sdf: {note}")
    mesh = reconstruct(grid, factor=factor, **options)
    points, triangles = vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(mesh.vertices, deep=True))
    corners = numpy_to_vtkIdTypeArray(mesh.faces.ravel().astype(np.int64), deep=True)
    triangles.SetData(3, corners)
    surface.SetPoints(points)
    surface.SetPolys(triangles)


if "inputs" in globals():  # in ParaView
    fill_surface(inputs[0].VTKObject, output.VTKObject, SCALARS, FACTOR, mesher=MESHER)  # noqa: F821
