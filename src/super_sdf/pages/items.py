"""What a page shows of each result: its entry, labels and texts, and its item, all the rest.

The file of an item is a script, since a page that was opened from a file may load scripts and
nothing else. Its first line is a comment with all but the meshes, so that a page of many files is
made without reading these; the second one hands the meshes to the page.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..check.check import Certificate, band_of, check_mesh, read_for_check
from ..options import Options
from ..errors import SuperSdfError
from ..files.output import naming, replacing
from ..grid.cubic import cubic_grid
from ..surface.mesh import Mesh
from .meshes import coarse_surface, packed_mesh, thumbnail

RESULT, COARSE = "super-sdf", "marching cubes of the samples"
LONGEST_HEAD = 1 << 20  # bytes of a file's first line
COMMENT = b"// "
CALL = "superSdfMeshes"  # the function of ``page.js``
LISTS = ("facts", "certificate", "stages", "faults", "notes", "warnings", "remarks")
NUMBERS = ("seconds", "residual", "thumbnail", "meshes")
COUNTED = ("vertices", "triangles", "band_voxels", "decoded_voxels", "noisy_voxels", "tiles")
NOT_DRAWN = "not drawn: run the command again for its picture and its meshes"

Entry = dict[str, Any]
"""A file in the JSON of a page.

id : what its meshes are found by
name, detail : what it is, and the grid and the mesh
status : "ok", "failed" or "waiting"; of a failed one ``reason``
line : counts in one line
seconds, residual : for sorting; None if unknown
thumbnail : a data URL or None
facts, certificate, stages : lists of label and text
faults, notes, warnings, remarks : lists of sentences
meshes : "page", "beside" or None: where its meshes are
"""


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
    options: Options,
    made: Any = None,
    certificate: Certificate | None = None,
) -> Item:
    """Return the item of a mesh and its grid; what cannot be made is said in it.

    The files are read unless what was ``made`` has the ``mesh`` and the ``grid``. The mesh is
    checked unless there is a certificate already.
    """
    try:
        shown, samples = read_for_check(mesh, grid, options, made)
    except SuperSdfError as error:
        return Item(certificate={"error": str(error)}, remarks=[f"not shown: {error}"])
    item, memory, band = Item(), options.max_memory, None
    try:
        band = band_of(samples, options)
        certificate = certificate or check_mesh(shown, samples, options)
        item.certificate = certificate.report()
    except SuperSdfError as error:
        item.certificate = {"error": str(error)}
    item.show(RESULT, shown, certificate, memory)
    if band:
        lattice, checked = cubic_grid(samples, options.offset), None
        coarse = coarse_surface(band, lattice)
        if certificate and len(coarse.faces):
            checked = check_mesh(coarse, samples, options, intersections=False)
        title = COARSE + (", made equally spaced" if lattice.shape != samples.shape else "")
        item.show(title, coarse, checked, memory)
    return item


def items_folder(page: Path) -> Path:
    """Return the folder beside a page for items: OUT-files beside OUT.html."""
    return page.with_name(f"{page.stem}-files")


def item_name(target: str) -> str:
    """Return the name of an item by its output: 16 hexadecimal digits."""
    return hashlib.sha256(target.encode("utf-8", "surrogatepass")).hexdigest()[:16]


def item_path(folder: Path, target: str) -> Path:
    """Return the file of the item of an output."""
    return folder / f"{item_name(target)}.js"


def keep_item(item: Item, folder: Path, target: str, sha256: str) -> None:
    """Write the item of an output whose mesh file has this hash; the folder is made for it."""
    item.made_of = sha256
    with naming(folder):
        folder.mkdir(exist_ok=True)
    write_item(item, item_path(folder, target))


def find_item(folder: Path, target: str, sha256: str) -> Item | None:
    """Return the item of an output without its meshes; None if there is none of this mesh."""
    item = read_head(item_path(folder, target))
    return item if item and item.made_of == sha256 else None


def remove_items(folder: Path, targets: Iterable[str]) -> None:
    """Remove the items of some outputs, and the folder if nothing else is in it."""
    with suppress(OSError):
        for target in targets:
            item_path(folder, target).unlink(missing_ok=True)
        folder.rmdir()


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


def entry_of(name: str, status: str = "ok", **known: Any) -> Entry:
    """Return an entry with what is known of a file; the rest is empty."""
    empty: Entry = {"id": "", "name": name, "status": status, "reason": "", "line": ""}
    return empty | dict.fromkeys(NUMBERS) | {key: [] for key in LISTS} | known


def entry_of_report(name: str, report: Mapping[str, Any], item: Item | None) -> Entry:
    """Return the entry of a mesh by its report, as ``Conversion.report`` has it, and its item.

    ``report`` may also have ``seconds``, in all or per stage; ``stages``; ``check``, a certificate;
    and ``input``, ``output``, ``model`` and the like.
    """
    stages = report["stages"] if "stages" in report else report.get("seconds", {})
    certificate = report.get("check") or (item.certificate if item else None) or {}
    return entry_of(
        name,
        line=_counts(report),
        seconds=report["seconds"] if "stages" in report else sum(stages.values()),
        residual=(certificate.get("residual") or {}).get("mean"),
        facts=_facts(report),
        stages=[[stage, f"{spent:.2f} s"] for stage, spent in stages.items()],
        certificate=certificate_facts(certificate),
        faults=certificate.get("faults", []),
        notes=[*report.get("inferred", []), *report.get("notes", [])],
        warnings=list(report.get("warnings", [])),
        thumbnail=item.thumbnail if item else None,
        remarks=item.remarks if item else [NOT_DRAWN],
    )


def _counts(report: Mapping[str, Any]) -> str:
    said = [f"{report['triangles']:,} triangles"] if "triangles" in report else []
    if "closed" in report:
        said.append("closed" if report["closed"] else "open")
    if "shape" in report:
        said.append(f"from {' x '.join(map(str, report['shape']))} samples")
    return ", ".join(said)


def _facts(report: Mapping[str, Any]) -> list[list[str]]:
    texts = {
        "grid": report.get("input") or report.get("in"),
        "mesh": report.get("output"),
        "samples": " x ".join(map(str, report.get("shape", ()))),
        "spacing": numbers(report.get("spacing", ())),
        "origin": numbers(report.get("origin", ())),
        "values": (report.get("field") or {}).get("kind"),
        **{key: report.get("asked", {}).get(key) for key in ("factor", "mesher")},
        **{key: report.get(key) for key in ("model", "precision", "device", "version")},
        **{key.replace("_", " "): f"{report[key]:,}" for key in COUNTED if key in report},
        "bounds": " to ".join(f"({numbers(corner)})" for corner in report.get("bounds", ())),
    }
    if simplified := report.get("simplified"):
        off = simplified["deviation"]
        texts["simplified"] = (
            f"from {simplified['triangles_before']:,} triangles; largest distance "
            f"{off['largest']:.4f} voxels, {off['largest_back']:.4f} back; "
            f"a voxel is {simplified['voxel_size']:.6g}"
        )
    return [[label, str(text)] for label, text in texts.items() if text not in (None, "")]


def tiles(entry: Entry) -> list[list[str]]:
    """Return the figures for the head of a page of one file."""
    shown = [row for row in entry["certificate"] if row[0] in ("mean residual", "largest residual")]
    faults = [["faults", str(len(entry["faults"]) or "none")]] if shown else []
    line = [["result", entry["line"]]] if entry["line"] else []
    return [*line, ["time", f"{entry['seconds']:.1f} s"], *shown, *faults]


def certificate_facts(found: Mapping[str, Any]) -> list[list[str]]:
    """Return what a certificate says, label by label; or why there is none."""
    if "error" in found:
        return [["not checked", found["error"]]]
    if not found:
        return []
    surface, residual = found["surface"], found["residual"]
    rows = [["checked", f"{found['samples']['exact']:,} exact samples near the surface"]]
    if residual:
        rows += [
            ["mean residual", f"{residual['mean']:.4f} voxels"],
            ["99th percentile", f"{residual['p99']:.4f} voxels"],
            ["largest residual", f"{residual['largest_signed']:+.4f} voxels"],
            ["above 0.1 voxel", f"{residual['share_above_tenth']:.2%} of the samples"],
        ]
    else:
        rows.append(["residual", "unknown, since no sample is exact"])
    kinds = ("closed", "oriented", "manifold")
    qualities = [("" if surface[key] else "not ") + key for key in kinds]
    pairs = surface["self_intersections"]
    return [
        *rows,
        ["surface", ", ".join(qualities)],
        ["components", f"{surface['components']:,}"],
        ["self-intersections", "not counted" if pairs is None else f"{pairs:,}"],
        ["volume", f"{surface['volume']:.6g}"],
        ["area", f"{surface['area']:.6g}"],
    ]


def numbers(values: Iterable[float]) -> str:
    """Return coordinates with commas, to six digits."""
    return ", ".join(f"{value:.6g}" for value in values)
