"""Items: what a page shows of one result besides its facts, and the files that hold them.

The file of an item is a script, since a page that was opened from a file may load scripts and
nothing else. Its first line is a comment with all but the meshes, so that a page of many files is
made without reading these; the second one hands the meshes to the page.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..certificate.check import Certificate, CheckOptions, check_mesh, read_for_check
from ..errors import SuperSdfError
from ..files.output import replacing
from ..grid.sdf_grid import SdfGrid
from ..mesh import Mesh
from .packing import pack
from .shown import Shown, shown_coarse, shown_result
from .thumbnails import thumbnail

RESULT = "super-sdf"
LONGEST_HEAD = 1 << 20  # bytes of a file's first line
COMMENT = b"// "
CALL = "superSdfMeshes"  # the function of ``page.js``


@dataclass
class Item:
    """What a page shows of one result.

    Attributes
    ----------
    thumbnail : str, optional
        A data URL.
    meshes : list
        The packed meshes: result, and coarse marching cubes if there are any.
    certificate : dict, optional
        What ``Certificate.report`` returns, or under ``error`` why there is none.
    remarks : list of str
        What is missing, and why.
    made_of : str
        The SHA-256 of the mesh file, if the item is kept in a file.
    size : int
        About how many bytes the meshes take in a page; of an item from a file.
    """

    thumbnail: str | None = None
    meshes: list[dict[str, Any]] = field(default_factory=list)
    certificate: dict[str, Any] | None = None
    remarks: list[str] = field(default_factory=list)
    made_of: str = ""
    size: int = 0


def item_of_files(
    mesh: str | Path,
    grid: str | Path,
    options: CheckOptions,
    certificate: Certificate | None = None,
    *,
    draw: bool = True,
) -> Item:
    """Return the item of a mesh file and its grid file; what cannot be made is said in it.

    With ``draw`` it has a thumbnail.
    """
    try:
        read = read_for_check(mesh, grid, options)
    except SuperSdfError as error:
        return Item(certificate={"error": str(error)}, remarks=[f"not shown: {error}"])
    return item_of(*read, options, certificate, draw=draw)


def item_of(
    mesh: Mesh,
    grid: SdfGrid,
    options: CheckOptions,
    certificate: Certificate | None = None,
    *,
    draw: bool = False,
) -> Item:
    """Return the item of a mesh and its grid, with a thumbnail if asked for."""
    item = Item()
    try:
        certificate = certificate or check_mesh(mesh, grid, options)
        item.certificate = certificate.report()
    except SuperSdfError as error:
        item.certificate = {"error": str(error)}
    coarse = replace(options, intersections=False)
    add_mesh(item, lambda: shown_result(RESULT, mesh, certificate, options.max_memory), draw=draw)
    add_mesh(item, lambda: shown_coarse(grid, coarse))
    return item


def add_mesh(item: Item, make: Callable[[], Shown], *, draw: bool = False) -> None:
    """Add a mesh to an item, with its thumbnail if asked for; or a remark why it is not shown."""
    try:
        shown = make()
        item.meshes.append(pack(shown))
    except SuperSdfError as error:
        item.remarks.append(f"not shown: {error}")
        return
    try:
        item.thumbnail = thumbnail(shown.mesh) if draw else item.thumbnail
    except Exception as error:  # whatever VTK raises where it cannot draw
        item.remarks.append(f"no picture: {type(error).__name__}: {error}")


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
    except (OSError, ValueError, TypeError):  # of another version, or damaged
        return None


def read_meshes(path: Path) -> list[dict[str, Any]]:
    """Return the packed meshes from the file of an item that was just written or read."""
    _, call = path.read_bytes().split(b"\n", 1)
    meshes: list[dict[str, Any]] = json.loads(call[call.index(b"[") : call.rindex(b"]") + 1])
    return meshes
