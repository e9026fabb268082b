"""Blender: File > Import > Distance grid (super-sdf) makes a fine mesh of a grid file.

An extension for Blender 4.2 and later: docs/guides/plugins.md says how it and super-sdf are
installed.
"""

import sys
from math import radians
from pathlib import Path

import bpy
from bpy.props import EnumProperty, FloatProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

MISSING = (
    "super-sdf is not installed in Blender's Python: run "
    f"'{sys.executable} -m pip install /path/to/super-sdf'"
)
SHARP_ANGLE = radians(30)  # between triangles, from which on an edge is shaded as an edge
FACTORS = [("0", "Automatic", "2 for masks, else 4")]
FACTORS += [(str(n), str(n), f"{n} times finer") for n in (2, 4, 8, 16)]
FIELDS = [
    ("auto", "Automatic", "Goes by the samples"),
    ("distance", "Distances", "Exact signed distances"),
    ("noisy", "Noisy distances", "Signed distances with noise"),
    ("mask", "Mask", "Two values, or the distance transform of a mask"),
    ("smooth", "Smooth field", "Its surface is that of a cubic spline"),
    ("density", "Densities", "A fog volume or an image, with the surface at a level"),
]
SHADINGS = [
    ("auto", "Automatic", "Smooth, but for edges of more than 30 degrees"),
    ("smooth", "Smooth", "Smooth everywhere"),
    ("flat", "Flat", "Shows the triangles"),
]


class ImportGrid(bpy.types.Operator, ImportHelper):
    """Make a fine mesh of a grid file: distances, a mask, densities or a level set."""

    bl_idname = "import_mesh.super_sdf"
    bl_label = "Import distance grid"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filter_glob: StringProperty(
        default="*.npy;*.npz;*.vdb;*.nii;*.nii.gz;*.nrrd;*.mha;*.mhd;*.vti;*.tif;*.h5;*.mrc;*.sdf",
        options={"HIDDEN"},
    )
    member: StringProperty(name="Grid", description="Name of the grid, if there are several")
    factor: EnumProperty(name="Factor", items=FACTORS, description="Fine voxels per voxel")
    field: EnumProperty(name="Values", items=FIELDS, description="Kind of the values")
    level: FloatProperty(name="Level", description="Density at the surface", precision=4)
    simplify: FloatProperty(
        name="Simplify",
        description="Largest error of simplifying, in voxels (0.02); 0 keeps all",
        min=0,
        precision=3,
    )
    scale: FloatProperty(
        name="Scale", description="Scale of the object: 0.001 for mm", default=1, min=1e-9
    )
    shading: EnumProperty(name="Shading", items=SHADINGS)

    def draw(self, context):
        """Show the options beside the file browser; the level for densities only."""
        names = ["member", "factor", "field", "level", "simplify", "scale", "shading"]
        for name in names:
            if name != "level" or self.field == "density":
                self.layout.prop(self, name)

    def execute(self, context):
        """Import the file; what is wrong is reported, and nothing is added to the scene."""
        try:
            from super_sdf import SuperSdfError
        except ModuleNotFoundError:
            self.report({"ERROR"}, MISSING)
            return {"CANCELLED"}
        manager = context.window_manager
        manager.progress_begin(0, 1)
        try:
            mesh, notes = self.refined(lambda done, total: manager.progress_update(done / total))
        except SuperSdfError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            manager.progress_end()
        for note in notes:
            self.report({"INFO"}, note)
        add_object(context, Path(self.filepath).stem, mesh, self.scale, self.shading)
        return {"FINISHED"}

    def refined(self, progress):
        """Return the mesh of the file, and the notes on what was inferred."""
        from super_sdf import read_grid, reconstruct, simplify_mesh

        kind = {"level": self.level} if self.field == "density" else {"field": self.field}
        path = f"{self.filepath}:{self.member}" if self.member else self.filepath
        grid = read_grid(path, **kind)
        mesh = reconstruct(grid, factor=int(self.factor) or None, progress=progress)
        if self.simplify:
            mesh = simplify_mesh(mesh, error=self.simplify * grid.voxel_size)
        return mesh, grid.notes


def add_object(context, name, mesh, scale, shading):
    """Add a mesh to the scene as the active object."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(mesh.vertices, [], mesh.faces)
    if shading == "flat":
        data.shade_flat()
    else:
        data.shade_smooth()
        if shading == "auto":
            data.set_sharp_from_angle(angle=SHARP_ANGLE)
    added = bpy.data.objects.new(name, data)
    added.scale = scale, scale, scale
    context.collection.objects.link(added)
    for each in context.selected_objects:
        each.select_set(False)
    added.select_set(True)
    context.view_layer.objects.active = added


def show_in_menu(menu, context):
    """Draw the entry of File > Import."""
    menu.layout.operator(ImportGrid.bl_idname, text="Distance grid (super-sdf)")


def register():
    """Add the operator and its entry."""
    bpy.utils.register_class(ImportGrid)
    bpy.types.TOPBAR_MT_file_import.append(show_in_menu)


def unregister():
    """Remove them."""
    bpy.types.TOPBAR_MT_file_import.remove(show_in_menu)
    bpy.utils.unregister_class(ImportGrid)
