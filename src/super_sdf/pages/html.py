"""One HTML page of facts, meshes, style and scripts; it can load nothing that is not its own.

Whatever comes from files is in blocks of JSON, which a browser does not take for markup, and is
shown as text. A content security policy names the hashes of the scripts and forbids all else.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from .. import __version__
from ..check import check
from ..convert import convert
from ..errors import SuperSdfError
from ..files.formats import is_grid
from ..files.output import replacing
from ..network.decoder import Decoder
from ..options import Options
from ..truth.mesh_files import read_mesh
from .items import (
    Entry,
    Item,
    entry_of,
    entry_of_report,
    find_item,
    item_of_files,
    item_path,
    items_folder,
    keep_item,
    numbers,
)

HOME = Path(__file__).parent
SCRIPTS = ("three.min.js", "viewer.js", "page.js")
GENERATOR = "super-sdf"
HEAD_BYTES = 4096  # of a page, in which its generator is looked for
MARKUP = {ord(c): f"\\u{ord(c):04x}" for c in "<>&"}  # of JSON in which a tag could be read


def make_page(
    facts: Mapping[str, Any], meshes: Mapping[str, Any] | None = None, *, beside: bool = False
) -> str:
    """Return a page of ``meshes``, packed and by the id of their entry.

    ``facts`` are ``title``, ``lead`` (a sentence), ``alert`` (a sentence or ""), ``summary`` (rows
    of label and text), ``notes`` and ``files``, entries. If ``beside``, the page may load scripts
    from beside it, with the meshes that are not in it.
    """

    def hash_of(text: str) -> str:
        """Return the hash by which a policy names an inline script or style."""
        digest = hashlib.sha256(text.encode("utf-8")).digest()
        return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"

    def safe(value: Any) -> str:
        """Return JSON in ASCII in which the characters of markup are escaped."""
        return json.dumps(value, ensure_ascii=True, allow_nan=False).translate(MARKUP)

    style = (HOME / "page.css").read_text("utf-8")
    scripts = [(HOME / name).read_text("utf-8") for name in SCRIPTS]
    own = " ".join(map(hash_of, scripts)) + (" 'self' file:" if beside else "")
    known = {
        "version": __version__,
        "made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "colours": {
            "touching": check.TOUCHING,
            "pierced": check.PIERCED,
            "unknown": check.UNKNOWN,
            "apart": check.NOT_TOUCHING,
            "full": check.FULL,
        },
    }
    blocks = [  # their names are ours, never a file's
        f'<script type="application/json" id="meshes-{name}">{safe(packed)}</script>'
        for name, packed in (meshes or {}).items()
    ]
    return Template((HOME / "page.html").read_text("utf-8")).substitute(
        policy=f"default-src 'none'; script-src {own}; style-src {hash_of(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'",
        generator=GENERATOR,
        style=style,
        facts=safe({**facts, **known}),
        meshes="\n".join(blocks),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def write_page(text: str, path: Path, *, force: bool = False) -> None:
    """Write a page, complete or not at all."""
    with replacing(path, force=force) as part:
        part.write_bytes(text.encode("utf-8"))


def is_page(path: Path) -> bool:
    """Return whether a file is a page that super-sdf has written."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return f'<meta name="generator" content="{GENERATOR}">'.encode() in head


def page_of_conversion(
    report: Mapping[str, Any],
    options: Options,
    made: Any = None,
    certificate: check.Certificate | None = None,
) -> str:
    """Return the page of a conversion.

    ``report`` is what ``upsample --json`` prints, with ``input`` and ``output``; these are read
    unless what was ``made`` has ``mesh`` and ``grid``. The mesh is checked unless there is a
    certificate already.
    """
    item = item_of_files(report["output"], report["input"], options, made, certificate)
    name = Path(report["output"]).name
    entry = entry_of_report(name, report, item)
    shown = [row for row in entry["certificate"] if row[0] in ("mean residual", "largest residual")]
    faults = [["faults", str(len(entry["faults"]) or "none")]] if shown else []
    summary = [["result", entry["line"]], ["time", f"{entry['seconds']:.1f} s"], *shown, *faults]
    return _whole_page(name, [(entry, item)], summary)


def viewed_page(sources: Sequence[str], load: Callable[[], Decoder], options: Options) -> str:
    """Return the page of some mesh files and grid files; all that it shows is within it.

    ``load`` returns the network, and is called if there is a grid; ``options`` say how that is
    refined.
    """
    network = load() if any(map(is_grid, sources)) else None
    shown = []
    for source in sources:
        name = Path(source).name
        if network is not None and is_grid(source):
            with TemporaryDirectory(prefix="super-sdf-") as folder:
                target = Path(folder, "mesh.ply")
                done = convert(source, target, network, options)
                item = item_of_files(target, source, options, done)
            said = {"input": source, "asked": options.digest(), "seconds": done.seconds}
            shown.append((entry_of_report(name, {**done.report(), **said}, item), item))
            continue
        mesh, item = read_mesh(source), Item()
        item.show(name, mesh)
        low, high = (numbers(corner(axis=0)) for corner in (mesh.vertices.min, mesh.vertices.max))
        bounds = ["bounds", f"({low}) to ({high})"]
        facts = [["mesh", source], ["vertices", f"{len(mesh.vertices):,}"], bounds]
        line = f"{len(mesh.faces):,} triangles, {'closed' if mesh.is_closed() else 'open'}"
        shown.append((entry_of(name, line=line, facts=facts, remarks=item.remarks), item))
    title = Path(sources[0]).name if len(sources) == 1 else f"{len(sources)} files"
    return _whole_page(title, shown, [])


def write_batch_page(
    path: Path,
    facts: Mapping[str, Any],
    rows: Mapping[str, Mapping[str, Any]],
    draw: Callable[[str], Item | None],
    interrupted: str = "",
    *,
    force: bool = False,
) -> None:
    """Write the page of a batch, files that failed first; their meshes are beside it.

    ``facts`` are title and lead; ``rows`` are of its report, by their output, empty while they are
    not finished. ``draw`` makes an item that is missing; ``interrupted`` says what ended the batch
    before its time.
    """
    folder, entries = items_folder(path), list[Entry]()
    for name, row in rows.items():
        if not row:
            entries.append(entry_of(name, "waiting", line="not finished"))
        elif row["status"] != "ok":
            of = [["grid", row["in"]], ["mesh", name]]
            entries.append(entry_of(name, "failed", reason=row["reason"], facts=of))
        else:
            digest, file = row["output"]["sha256"], item_path(folder, name)
            item = find_item(folder, name, digest)
            if item is None:
                with suppress(SuperSdfError):  # then it is not shown
                    if made := draw(name):
                        keep_item(made, folder, name, digest)
                item = find_item(folder, name, digest)
            report = {**row, "input": row["in"], "output": name}
            entry = entry_of_report(name, report, item) | {"id": file.stem}
            if item and item.size:
                entry["meshes"] = quote(f"{folder.name}/{file.name}")
            entries.append(entry)
    kinds = {"failed": 0, "waiting": 1, "ok": 3}
    entries.sort(
        key=lambda e: (2 if e["faults"] or e["warnings"] else kinds[e["status"]], e["name"])
    )
    counts = {
        "files": len(entries),
        "failed": sum(entry["status"] == "failed" for entry in entries),
        "not finished": sum(entry["status"] == "waiting" for entry in entries),
        "with faults": sum(bool(entry["faults"]) for entry in entries),
        "with warnings": sum(bool(entry["warnings"]) for entry in entries),
    }
    summary = [[k, f"{count:,}"] for k, count in counts.items() if count or k == "files"]
    left, why = counts["not finished"], f", {interrupted}" if interrupted else ""
    alert = f"Incomplete{why}: {left} not finished; run it again to go on" if left or why else ""
    said = {**facts, "alert": alert, "notes": [], "summary": summary, "files": entries}
    write_page(make_page(said, beside=True), path, force=force or is_page(path))


def _whole_page(
    title: str, shown: Sequence[tuple[Entry, Item]], summary: Sequence[Sequence[str]]
) -> str:
    """Return a page with the meshes of its entries; ``summary`` are rows of label and text."""
    meshes = {str(number): item.meshes for number, (_, item) in enumerate(shown)}
    entries = [
        entry | {"id": str(number), "meshes": "page" if item.meshes else None}
        for number, (entry, item) in enumerate(shown)
    ]
    facts = {"title": title, "lead": "", "alert": "", "notes": [], "files": entries}
    return make_page({**facts, "summary": summary}, meshes)
