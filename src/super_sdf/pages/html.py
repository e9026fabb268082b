"""One HTML page of facts, meshes, style and scripts; it can load nothing that is not its own.

Whatever comes from files is in blocks of JSON, which a browser does not take for markup, and is
shown as text. A content security policy names the hashes of the scripts and forbids all else.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from .. import __version__, check, load_network
from ..convert import convert
from ..files.formats import is_grid
from ..files.output import replacing
from ..truth import read_mesh
from . import items
from .items import Entry, Item, entry_of_report, item_of

if TYPE_CHECKING:
    from ..options import Options

HOME = Path(__file__).parent
SCRIPTS = ("three.min.js", "viewer.js", "page.js")
GENERATOR = "super-sdf"
EMPTY = {"lead": "", "summary": [], "notes": []}
MARKUP = {ord(c): f"\\u{ord(c):04x}" for c in "<>&"}  # of JSON in which a tag could be read


def make_page(
    facts: Mapping[str, Any], meshes: Mapping[str, Any] | None = None, *, beside: bool = False
) -> str:
    """Return a page of ``meshes``, packed and by the id of their entry.

    ``facts`` are ``title``, ``files``, which are entries, and some of ``EMPTY``. If ``beside``, the
    page may load scripts from beside it, with the meshes that are not in it.
    """

    def hash_of(text: str) -> str:
        digest = hashlib.sha256(text.encode("utf-8")).digest()
        return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"

    def safe(value: Any) -> str:
        return json.dumps(value, ensure_ascii=True, allow_nan=False).translate(MARKUP)

    style = (HOME / "page.css").read_text("utf-8")
    scripts = [(HOME / name).read_text("utf-8") for name in SCRIPTS]
    own = " ".join(map(hash_of, scripts)) + (" 'self' file:" if beside else "")
    colours: dict[str, Any] = {"touching": (240, 240, 240), "pierced": (190, 20, 30)}
    colours |= {"unknown": (120, 120, 60), "apart": (20, 70, 190), "full": check.FULL}
    made = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    known = {"version": __version__, "made": made, "colours": colours}
    blocks = [  # their names are ours, never a file's
        f'<script type="application/json" id="meshes-{name}">{safe(packed)}</script>'
        for name, packed in (meshes or {}).items()
    ]
    return Template((HOME / "page.html").read_text("utf-8")).substitute(
        policy=f"default-src 'none'; script-src {own}; style-src {hash_of(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'",
        generator=GENERATOR,
        style=style,
        facts=safe({**EMPTY, **facts, **known}),
        meshes="\n".join(blocks),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def write_page(text: str, path: Path, *, force: bool = False) -> None:
    """Write a page, complete or not at all."""
    with replacing(path, force=force) as part:
        part.write_bytes(text.encode("utf-8"))


def is_page(path: Path) -> bool:
    """Return whether a file is a page that super-sdf has written."""
    with suppress(OSError), path.open("rb") as file:
        return f'<meta name="generator" content="{GENERATOR}">'.encode() in file.read(4096)
    return False


def page_of_conversion(
    report: Mapping[str, Any],
    options: Options,
    made: Any,
    certificate: check.Certificate | None = None,
) -> str:
    """Return the page of a conversion by what ``upsample --json`` says; see ``item_of``."""
    item = item_of(made, options, certificate)
    entry = entry_of_report(name := Path(report["output"]).name, report, item)
    return _whole_page(name, [(entry, item)])


def viewed_page(sources: Sequence[str], options: Options) -> str:
    """Return the page of mesh files, and of the meshes that grid files become."""
    network = load_network(**options.network()) if any(map(is_grid, sources)) else None
    shown = []
    for source in sources:
        name = Path(source).name
        if network is not None and is_grid(source):
            with TemporaryDirectory(prefix="super-sdf-") as folder:
                done = convert(source, Path(folder, "mesh.ply"), network, options)
                item = item_of(done, options)
            report = {**done.facts, "input": source, "asked": options.digest()}
            report["seconds"] = done.seconds
        else:
            mesh, item = read_mesh(source), Item()
            item.show(name, mesh)
            report = {"output": source, "vertices": len(mesh.vertices)}
            report |= {"triangles": len(mesh.faces), "closed": mesh.is_closed()}
            report["bounds"] = [mesh.vertices.min(0), mesh.vertices.max(0)]
        shown.append((entry_of_report(name, report, item), item))
    title = Path(sources[0]).name if len(sources) == 1 else f"{len(sources)} files"
    return _whole_page(title, shown)


def write_batch_page(
    path: Path,
    facts: Mapping[str, Any],
    rows: Mapping[str, Mapping[str, Any]],
    *,
    force: bool = False,
) -> None:
    """Write the page of a batch, files that failed first; their meshes are beside it.

    ``rows`` are lines of the report by their output, empty of what is not finished.
    """
    folder, entries = items.items_folder(path), list[Entry]()
    for name, row in rows.items():
        if row.get("status") != "ok":
            known: dict[str, Any] = {"line": "not finished"}
            if row:
                known = {"reason": row["reason"], "facts": [["grid", row["in"]], ["mesh", name]]}
            entries.append(items.entry_of(name, row.get("status", "waiting"), **known))
            continue
        item = items.find_item(folder, name, row["output"]["sha256"])
        file = items.item_path(folder, name)
        entries.append(entry_of_report(name, {**row, "output": name}, item) | {"id": file.stem})
        if item and item.size:
            entries[-1]["meshes"] = quote(f"{folder.name}/{file.name}")
    kinds = {"failed": 0, "waiting": 1, "doubtful": 2, "ok": 3}
    of = {e["name"]: "doubtful" if e["faults"] or e["warnings"] else e["status"] for e in entries}
    entries.sort(key=lambda entry: (kinds[of[entry["name"]]], entry["name"]))
    counts = {"files": len(entries), "failed": sum(bool(entry["reason"]) for entry in entries)}
    for key in ("faults", "warnings"):
        counts[f"with {key}"] = sum(bool(entry[key]) for entry in entries)
    summary = [[words, f"{count:,}"] for words, count in counts.items() if count]
    page = make_page({**facts, "summary": summary, "files": entries}, beside=True)
    write_page(page, path, force=force or is_page(path))


def _whole_page(title: str, shown: Sequence[tuple[Entry, Item]]) -> str:
    """Return a page with the meshes of its entries."""
    for number, (entry, item) in enumerate(shown):
        entry |= {"id": str(number), "meshes": "page" if item.meshes else None}
    meshes = {entry["id"]: item.meshes for entry, item in shown}
    return make_page({"title": title, "files": [entry for entry, _ in shown]}, meshes)
