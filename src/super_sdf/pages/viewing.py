"""Pages that hold all that they show: of one conversion, and of ``super-sdf view``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ..certificate.check import Certificate, CheckOptions
from ..convert import ConvertOptions, convert
from ..files.formats import is_grid
from ..network.decoder import Decoder
from ..truth.mesh_files import read_mesh
from .entries import Entry, entry_of, entry_of_report, numbers, tiles
from .html import make_page, write_page
from .items import Item, add_mesh, item_of_files
from .shown import shown_result


def write_single(
    path: Path,
    report: Mapping[str, Any],
    options: CheckOptions,
    certificate: Certificate | None = None,
    *,
    force: bool = False,
) -> None:
    """Write the page of a conversion.

    Parameters
    ----------
    path : Path
        The page.
    report : dict
        As ``upsample --json`` prints it: with ``input`` and ``output``.
    options : CheckOptions
        How the grid is read again.
    certificate : Certificate, optional
        If there is one already.
    force : bool
        Replace the page if it exists.

    Raises
    ------
    WriteError
        If it cannot be written.
    """
    item = item_of_files(report["output"], report["input"], options, certificate)
    name = Path(report["output"]).name
    entry = entry_of_report(name, report, item)
    write_page(whole_page(name, [(entry, item)], tiles(entry)), path, force=force)


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
    shown = []
    for source in sources:
        seen = view_grid(source, network, options) if network and is_grid(source) else None
        shown.append(seen or view_mesh(source, options.max_memory))
    title = Path(sources[0]).name if len(sources) == 1 else f"{len(sources)} files"
    return whole_page(title, shown)


def whole_page(
    title: str, shown: Sequence[tuple[Entry, Item]], summary: Sequence[Sequence[str]] = ()
) -> str:
    """Return a page with the meshes of its entries; ``summary`` are rows of label and text."""
    entries, meshes = [], {}
    for number, (entry, item) in enumerate(shown):
        meshes[str(number)] = item.meshes
        within = "page" if item.meshes else None
        entries.append(entry | {"id": str(number), "meshes": within})
    facts = {"title": title, "lead": "", "alert": "", "notes": [], "files": entries}
    return make_page({**facts, "summary": summary}, meshes)


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
