"""Blender: a grid file becomes a mesh object, refined.

In Blender's Scripting editor, or from its Python console:

    import sys; sys.path.append("/path/to/examples/tools")
    from blender_import import import_grid
    import_grid("part.npz", scale=0.001)                      # millimetres to Blender's metres

Without a window, with the program or with bpy from PyPI:

    blender --background --python blender_import.py -- part.npz part.blend part.png
    python blender_import.py part.npz part.blend part.png

If Blender's Python lacks super-sdf, the command is run instead (SUPER_SDF says where it is).
"""

import os
import subprocess
import sys
import tempfile
from math import radians
from pathlib import Path

SHARP_ANGLE = 30  # degrees between triangles, from which on an edge is shaded as an edge


def import_grid(path, factor=4, mesher="marching", shading="auto", scale=1.0):
    """Add the refined surface of a grid file to the scene; return the object.

    Shading is "smooth", "flat", or "auto": smooth, except at edges of more than SHARP_ANGLE.
    """
    try:
        vertices, faces = refine(path, factor, mesher)
        found = object_of(Path(path).stem, vertices, faces)
    except ImportError:
        found = import_by_command(path, factor, mesher)
    found.scale = (scale, scale, scale)
    shade(found.data, shading)
    return found


def refine(path, factor=4, mesher="marching"):
    """Return the vertices (n, 3) and the triangles (m, 3) of a grid file's surface."""
    from super_sdf import read_grid, reconstruct

    mesh = reconstruct(read_grid(path), factor=factor, mesher=mesher)
    return mesh.vertices, mesh.faces


def object_of(name, vertices, faces):
    """Return a new object of the scene with these triangles."""
    import bpy

    data = bpy.data.meshes.new(name)
    data.from_pydata(vertices, [], faces)
    found = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(found)
    return found


def run_command(path, mesh, factor=4, mesher="marching"):
    """Write the surface of a grid file as a mesh file, with the command super-sdf."""
    command = [os.environ.get("SUPER_SDF", "super-sdf"), "upsample", str(path), str(mesh)]
    options = ["--factor", str(factor), "--mesher", mesher, "--quiet"]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr.strip())


def import_by_command(path, factor, mesher):
    """Return a new object of the scene, by way of a PLY file."""
    import bpy

    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / f"{Path(path).stem}.ply"
        run_command(path, mesh, factor, mesher)
        bpy.ops.wm.ply_import(filepath=str(mesh))
    return bpy.context.view_layer.objects.active


def shade(data, shading):
    """Shade a mesh smooth, flat, or smooth between its edges."""
    if shading == "flat":
        data.shade_flat()
        return
    data.shade_smooth()
    if shading == "auto":
        data.set_sharp_from_angle(angle=radians(SHARP_ANGLE))


def render(found, picture, size=800):
    """Draw an object from the front and above with Cycles, on the CPU."""
    import bpy
    from mathutils import Vector

    scene = bpy.context.scene
    bpy.context.view_layer.update()
    corners = [found.matrix_world @ Vector(corner) for corner in found.bound_box]
    middle, extent = sum(corners, Vector()) / 8, (corners[6] - corners[0]).length
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    towards = Vector((-1, -1.3, 1.1)).normalized()
    camera.location = middle + 1.6 * extent * towards
    camera.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
    camera.data.clip_end = 10 * extent
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3, (radians(40), radians(-20), radians(20))
    for each in (camera, sun):
        scene.collection.objects.link(each)
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("sky")
    scene.world.color = (0.5, 0.5, 0.5)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 24
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.filepath = str(Path(picture).absolute())
    bpy.ops.render.render(write_still=True)


def main(grid, blend=None, picture=None):
    """Import a grid into an empty scene; save that scene and a picture, if they are named."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    found = import_grid(grid)
    print(
        f"{found.name}: {len(found.data.polygons):,} triangles in Blender {bpy.app.version_string}"
    )
    if blend:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(blend).absolute()))
    if picture:
        render(found, picture)


if __name__ == "__main__":
    main(*(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
