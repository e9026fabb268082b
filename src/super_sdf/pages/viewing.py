"""The page of ``super-sdf view``: meshes, and grids that are refined for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from ..certificate.check import CheckOptions
from ..convert import ConvertOptions, convert
from ..files.formats import is_grid
from ..network.decoder import Decoder
from ..truth.mesh_files import read_mesh
from .entries import Entry, entry_of, entry_of_report, numbers
from .html import make_page
from .items import Item, add_mesh, item_of_files
from .shown import shown_result


def viewed_page(
    sources: Sequence[str], load: Callable[[], Decoder], options: ConvertOptions
) -> str:
    """Return the page of some meshes and grids; all that it shows is within it.

    Parameters
    ----------
    sources : list of str
        Mesh files and grid files.
    load : callable
        Returns the network; called if there is a grid.
    options : ConvertOptions
        How the grids are refined.

    Raises
    ------
    SuperSdfError
        If a file cannot be read or refined.
    """
    network = load() if any(map(is_grid, sources)) else None
    entries, meshes = [], {}
    for number, source in enumerate(sources):
        seen = view_grid(source, network, options) if network and is_grid(source) else None
        entry, item = seen or view_mesh(source, options.max_memory)
        meshes[str(number)] = item.meshes
        within = "page" if item.meshes else None
        entries.append(entry | {"id": str(number), "meshes": within})
    title = Path(sources[0]).name if len(sources) == 1 else f"{len(sources)} files"
    facts = {"title": title, "lead": "", "alert": "", "summary": [], "notes": [], "files": entries}
    return make_page(facts, meshes)


def view_grid(source: str, network: Decoder, options: ConvertOptions) -> tuple[Entry, Item]:
    """Refine a grid; return what the page says and shows of it."""
    with TemporaryDirectory(prefix="super-sdf-") as folder:
        target = Path(folder, "mesh.ply")
        done = convert(source, target, network, options)
        check = replace(CheckOptions.of(options), processes=0)
        item = item_of_files(target, source, check, draw=False)
    report = {**done.report(), "input": source, "factor": options.factor}
    report |= {"mesher": options.mesher, "seconds": done.seconds}
    return entry_of_report(Path(source).name, report, item), item


def view_mesh(source: str, max_memory: int | None = None) -> tuple[Entry, Item]:
    """Read a mesh; return what the page says and shows of it."""
    mesh, item = read_mesh(source), Item()
    add_mesh(item, lambda: shown_result(Path(source).name, mesh, None, max_memory))
    closed = "closed" if mesh.is_closed() else "open"
    corners = (numbers(mesh.vertices.min(0)), numbers(mesh.vertices.max(0)))
    facts = [["mesh", source], ["vertices", f"{len(mesh.vertices):,}"]]
    facts.append(["bounds", f"({corners[0]}) to ({corners[1]})"])
    line = f"{len(mesh.faces):,} triangles, {closed}"
    return entry_of(Path(source).name, line=line, facts=facts, remarks=item.remarks), item
