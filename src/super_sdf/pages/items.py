"""Items: what a page shows of one result besides its facts, and the files that hold them.

The file of an item is a script, since a page that was opened from a file may load scripts and
nothing else. Its first line is a comment with all but the meshes, so that a page of many files is
made without reading these; the second one hands the meshes to the page.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..certificate.check import Certificate, band_of, check_kept, read_for_check
from ..convert import ConvertOptions, Kept
from ..errors import SuperSdfError
from ..files.output import replacing
from ..grid.cubic import cubic_grid
from ..mesh import Mesh
from .meshes import coarse_surface, packed_mesh, thumbnail

RESULT, COARSE = "super-sdf", "marching cubes of the samples"
LONGEST_HEAD = 1 << 20  # bytes of a file's first line
COMMENT = b"// "
CALL = "superSdfMeshes"  # the function of ``page.js``


@dataclass
class Item:
    """What a page shows of one result."""

    thumbnail: str | None = None  # a data URL
    meshes: list[dict[str, Any]] = field(default_factory=list)  # packed: result, coarse mesh
    certificate: dict[str, Any] | None = None  # or, under "error", why there is none
    remarks: list[str] = field(default_factory=list)  # what is missing, and why
    made_of: str = ""  # the SHA-256 of the mesh file, if the item is kept in a file
    size: int = 0  # about how many bytes the meshes take in a page; of an item from a file

    def show(
        self,
        title: str,
        mesh: Mesh,
        certificate: Certificate | None = None,
        max_memory: int | None = None,
    ) -> None:
        """Add a mesh, or a remark why it is not shown; the first one is also in the thumbnail."""
        self.thumbnail = self.thumbnail or thumbnail(mesh)
        try:
            self.meshes.append(packed_mesh(title, mesh, certificate, max_memory))
        except SuperSdfError as error:
            self.remarks.append(f"not shown: {error}")


def item_of_files(
    mesh: str | Path,
    grid: str | Path,
    options: ConvertOptions,
    kept: Kept | None = None,
    certificate: Certificate | None = None,
    processes: int = 1,
) -> Item:
    """Return the item of a mesh and its grid; what cannot be made is said in it.

    The files are read unless the conversion has ``kept`` what is in them.
    """
    try:
        kept = read_for_check(mesh, grid, options, kept)
    except SuperSdfError as error:
        return Item(certificate={"error": str(error)}, remarks=[f"not shown: {error}"])
    return item_of(kept, options, certificate, processes)


def item_of(
    kept: Kept,
    options: ConvertOptions,
    certificate: Certificate | None = None,
    processes: int = 1,
) -> Item:
    """Return the item of a mesh and its grid, checked unless there is a certificate already."""
    item, memory = Item(), options.max_memory
    try:
        kept = replace(kept, band=band_of(kept, options))
        certificate = certificate or check_kept(kept, options, processes=processes)
        item.certificate = certificate.report()
    except SuperSdfError as error:
        item.certificate = {"error": str(error)}
    item.show(RESULT, kept.mesh, certificate, memory)
    if kept.band:
        lattice, checked = cubic_grid(kept.grid, options.offset), None
        coarse = coarse_surface(kept.band, lattice)
        if certificate and len(coarse.faces):
            checked = check_kept(replace(kept, mesh=coarse), options, intersections=False)
        title = COARSE + (", made equally spaced" if lattice.shape != kept.grid.shape else "")
        item.show(title, coarse, checked, memory)
    return item


def write_item(item: Item, path: Path) -> None:
    """Write the file of an item, complete or not at all; its stem is the id that the page uses."""
    size = sum(len(mesh["data"]) for mesh in item.meshes)
    head = json.dumps({**vars(item), "meshes": [], "size": size})
    call = f"{CALL}({json.dumps(path.stem)}, {json.dumps(item.meshes)});"
    with replacing(path) as part:
        part.write_bytes(COMMENT + f"{head}\n{call}\n".encode("ascii"))


def read_head(path: Path) -> Item | None:
    """Return an item from its file, without the meshes; None if there is none."""
    try:
        with path.open("rb") as file:
            line = file.readline(LONGEST_HEAD)
        return Item(**json.loads(line.removeprefix(COMMENT)))
    except (OSError, ValueError, TypeError):  # missing, or damaged
        return None


def read_meshes(path: Path) -> list[dict[str, Any]]:
    """Return the packed meshes from the file of an item that was just written or read."""
    _, call = path.read_bytes().split(b"\n", 1)
    meshes: list[dict[str, Any]] = json.loads(call[call.index(b"[") : call.rindex(b"]") + 1])
    return meshes
