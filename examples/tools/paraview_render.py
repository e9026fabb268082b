"""ParaView without a window: coarse contour and refined surface of a .vti file, in one picture.

    pvpython examples/tools/paraview_render.py FIELD.vti [PICTURE.png] [SURFACE.vtp]

Left is ParaView's own Contour at 0, right the Programmable Filter of paraview_filter.py.
"""

import sys
from pathlib import Path

FILTER = Path(__file__).with_name("paraview_filter.py")


def refined(source):
    """Return the Programmable Filter of ``paraview_filter.py`` on a source."""
    from paraview import simple

    found = simple.ProgrammableFilter(Input=source)
    found.OutputDataSetType = "vtkPolyData"
    found.Script = FILTER.read_text()
    return found


def draw(surface, layout_cell, camera=None):
    """Show a surface with flat shading in a cell of the layout; return its view."""
    from paraview import simple

    view = simple.CreateRenderView(UseColorPaletteForBackground=0, Background=[1, 1, 1])
    simple.AssignViewToLayout(view, simple.GetLayout(), layout_cell)
    shown = simple.Show(surface, view)
    shown.Interpolation = "Flat"
    shown.ColorArrayName = [None, ""]  # one colour
    shown.DiffuseColor = shown.AmbientColor = [0.72, 0.76, 0.8]
    view.OrientationAxesVisibility = 0
    if camera is None:
        view.CameraPosition, view.CameraFocalPoint, view.CameraViewUp = (
            [-1, -1.3, 1.1],
            [0] * 3,
            [0, 0, 1],
        )
        simple.ResetCamera(view)
    else:
        simple.AddCameraLink(camera, view, "same camera")
    return view


def main(field, picture="part.png", surface="part.vtp"):
    """Refine a file, draw it beside the coarse contour, and save the surface."""
    from paraview import simple

    image = simple.XMLImageDataReader(FileName=[field])
    image.UpdatePipeline()
    name = image.PointData[0].Name
    coarse = simple.Contour(Input=image, ContourBy=["POINTS", name], Isosurfaces=[0.0])
    fine = refined(image)
    coarse.UpdatePipeline()
    fine.UpdatePipeline()
    counts = [s.GetDataInformation().GetNumberOfCells() for s in (coarse, fine)]
    if not counts[1]:
        sys.exit("the filter made no surface: its error is above")
    layout = simple.CreateLayout("coarse and fine")
    layout.SplitHorizontal(0, 0.5)
    left = draw(coarse, 1)
    draw(fine, 2, left)
    layout.SetSize(1600, 800)
    simple.SaveScreenshot(picture, layout, ImageResolution=[1600, 800])
    simple.SaveData(surface, fine)
    print(f"{counts[0]:,} triangles by Contour, {counts[1]:,} by super-sdf: {picture}, {surface}")


if __name__ == "__main__":
    main(*sys.argv[1:])
