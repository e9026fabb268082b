"""The writers of OBJ, OFF, binary glTF (by trimesh) and 3MF; see ``meshes``.

Each writes meshes by their names (OBJ and OFF: the only one) to a path, with what the file says of
them. Text has enough digits to read back the same numbers: trimesh writes .obj and .off with fixed
decimals, and .3mf in millimetres alone and without colours.
"""

from __future__ import annotations

import html
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError
from ..options import LENGTHS

if TYPE_CHECKING:
    from .meshes import Parts, World

TEXT_CHUNK = 1 << 14  # rows of text at a time: Python numbers take ten times the memory
GLB_MOST_BYTES = 2**32 - 1  # the length in the header has 32 bits


def write_obj(parts: Parts, path: Path, world: World) -> None:
    """Write Wavefront OBJ, whose vertex indices start at 1."""
    (mesh,) = parts.values()
    with path.open("wb") as file:
        file.write(f"# made by super-sdf {world.note}".rstrip().encode("ascii") + b"\n")
        file.writelines(_lines("v %s %s %s\n", mesh.vertices))
        file.writelines(_lines("f %d %d %d\n", mesh.faces, first=1))


def write_off(parts: Parts, path: Path, world: World) -> None:
    """Write OFF."""
    (mesh,) = parts.values()
    with path.open("wb") as file:
        file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode("ascii"))
        file.writelines(_lines("%s %s %s\n", mesh.vertices))
        file.writelines(_lines("3 %d %d %d\n", mesh.faces))


def _lines(line: str, rows: NDArray[Any], first: int = 0) -> Iterator[bytes]:
    """Yield rows as text; indices count from ``first``.

    9 digits identify every float32; of float64 it is the shortest text that reads back the same.
    """
    line = line.replace("%s", "%r" if rows.dtype == np.float64 else "%.9g")
    for start in range(0, len(rows), TEXT_CHUNK):
        some = rows[start : start + TEXT_CHUNK]
        if first:  # the last index may exceed 32 bits
            some = some.astype(np.int64) + first
        yield ((line * len(some)) % tuple(some.ravel().tolist())).encode("ascii")


def write_glb(parts: Parts, path: Path, world: World) -> None:
    """Write binary glTF, a node for each part.

    Vertices are float32, relative to ``world.origin``; the nodes move them there, and scale them
    from the unit to metres, those of glTF. FileError if a mesh has no triangle, which glTF does not
    allow, or the file exceeds 4.29 GB.
    """
    import trimesh

    library: Any = trimesh  # parts of it have no types

    metres = LENGTHS[world.unit or "m"]
    place = np.diag([metres, metres, metres, 1.0])
    place[:3, 3] = metres * np.array(world.origin)
    total = sum(12 * (len(mesh.vertices) + len(mesh.faces)) for mesh in parts.values())
    if total > 0.999 * GLB_MOST_BYTES:  # there is a header, too
        raise FileError(f"the mesh takes {total:,} bytes, .glb holds 4,294,967,295: give .ply")
    scene = library.Scene()
    for name, mesh in parts.items():
        if not len(mesh.faces):
            raise FileError("a mesh without triangles cannot be .glb: give .ply")
        shown = None
        if colour := world.colours.get(name):
            rgb = np.array(colour) / 255  # of sRGB; a factor of glTF is linear
            rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
            factor = np.rint(255 * np.array([*rgb, 1])).astype(np.uint8)
            about = library.visual.material.PBRMaterial(
                name, baseColorFactor=factor, metallicFactor=0
            )
            shown = library.visual.TextureVisuals(material=about)
        vertices = mesh.vertices - np.array(world.origin) if any(world.origin) else mesh.vertices
        part = library.Trimesh(vertices, mesh.faces, process=False, visual=shown)
        scene.add_geometry(part, name or "mesh", name or "mesh", transform=place)
    path.write_bytes(scene.export(file_type="glb", include_normals=False))


HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
SCHEMAS = "http://schemas.openxmlformats.org/package/2006"
MICROSOFT = "http://schemas.microsoft.com/3dmanufacturing"
MEMBERS = {
    "[Content_Types].xml": (
        f'<Types xmlns="{SCHEMAS}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" '
        'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
    ),
    "_rels/.rels": (
        f'<Relationships xmlns="{SCHEMAS}/relationships"><Relationship Target="/3D/3dmodel.model" '
        f'Id="rel0" Type="{MICROSOFT}/2013/01/3dmodel"/></Relationships>\n'
    ),
}
MODEL = f'<model unit="{{}}" xml:lang="en-US" xmlns="{MICROSOFT}/core/2015/02">\n<resources>'
UNITS = {"um": "micron", "mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch",
         "ft": "foot"}  # fmt: skip
COMPRESSION = 1  # the fastest level: higher ones save a tenth and take three times as long


def write_3mf(parts: Parts, path: Path, world: World) -> None:
    """Write 3MF, an object for each part, in a unit or the format's default, the millimetre.

    Members opened by name have no date, so the same mesh always gives the same file.
    """
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for member, text in MEMBERS.items():
            with archive.open(member, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + MODEL.format(UNITS[world.unit or "mm"])).encode("ascii"))
            for number, (name, mesh) in enumerate(parts.items(), 1):
                quoted, shown = f'"{html.escape(name)}"', ""
                named = f" name={quoted}" if name else ""
                if name in world.colours:
                    colour = "#{:02X}{:02X}{:02X}".format(*world.colours[name])
                    material = len(parts) + number
                    shown = f'<basematerials id="{material}"><base name={quoted} '
                    shown += f'displaycolor="{colour}"/></basematerials>'
                    named += f' pid="{material}" pindex="0"'
                shown += f'<object id="{number}"{named} type="model"><mesh><vertices>\n'
                file.write(shown.encode("utf-8"))
                file.writelines(_lines('<vertex x="%s" y="%s" z="%s"/>\n', mesh.vertices))
                file.write(b"</vertices><triangles>\n")
                file.writelines(_lines('<triangle v1="%d" v2="%d" v3="%d"/>\n', mesh.faces))
                file.write(b"</triangles></mesh></object>")
            items = "".join(f'<item objectid="{n}"/>' for n in range(1, len(parts) + 1))
            file.write(f"</resources><build>{items}</build></model>\n".encode("ascii"))
