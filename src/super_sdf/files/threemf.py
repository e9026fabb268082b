"""3MF: a zip archive with the mesh as XML, compressed while it is written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from .spool import TEXT_CHUNK, little_endian, spool_beside, write_in_chunks, write_split
from .text_meshes import index_lines, number_lines

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
TYPES = (
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
)
RELATIONS = (
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>\n'
)
COMPRESSION = 1  # the fastest level: higher ones save a tenth and take three times as long
BEFORE = (
    '<model unit="millimeter" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n<resources>'
)
OBJECT = '<object id="{}"{} type="model"><mesh><vertices>\n'
BETWEEN = "</vertices><triangles>\n"
END = "</triangles></mesh></object>"
ITEM = '<item objectid="{}"/>'


def write_3mf(pieces: Iterable[Mesh], path: Path) -> None:
    """Write a mesh as 3MF: see ``write_3mf_parts``."""
    write_3mf_parts({"": pieces}, path)


def write_3mf_parts(parts: Mapping[str, Iterable[Mesh]], path: Path) -> None:
    """Write meshes by their names as 3MF in the format's default unit, the millimetre.

    Members opened by name have no date, so the same mesh always gives the same file.
    """
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for name, text in (("[Content_Types].xml", TYPES), ("_rels/.rels", RELATIONS)):
            with archive.open(name, "w") as file:
                file.write((HEAD + text).encode("ascii"))
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            file.write((HEAD + BEFORE).encode("ascii"))
            for number, (name, pieces) in enumerate(parts.items(), 1):
                named = f' name="{name}"' if name else ""
                file.write(OBJECT.format(number, named).encode("ascii"))
                with spool_beside(path) as waiting:
                    _write_mesh(pieces, file, waiting)
                file.write(END.encode("ascii"))
            items = "".join(ITEM.format(number) for number in range(1, len(parts) + 1))
            file.write(f"</resources><build>{items}</build></model>\n".encode("ascii"))


def _write_mesh(pieces: Iterable[Mesh], file: IO[bytes], waiting: IO[bytes]) -> None:
    """Write a mesh; its triangles wait as binary numbers, which take half as much as text."""
    vertices = number_lines('<vertex x="%s" y="%s" z="%s"/>\n')
    write_split(pieces, (file, waiting), (vertices, _wide), TEXT_CHUNK)
    file.write(BETWEEN.encode("ascii"))
    waiting.seek(0)
    triangles = index_lines('<triangle v1="%d" v2="%d" v3="%d"/>\n')
    while rows := waiting.read(24 * TEXT_CHUNK):
        write_in_chunks(file, np.frombuffer(rows, "<i8").reshape(-1, 3), triangles, TEXT_CHUNK)


def _wide(faces: NDArray[Any]) -> bytes:
    return little_endian(faces.astype(np.int64))
