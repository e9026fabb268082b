"""What a page shows of each result: its entry, labels and texts, and its item, all the rest.

The file of an item is a script, since a page that was opened from a file may load scripts and
nothing else. Its first line is a comment with all but the meshes, so that a page of many files is
made without reading these; the second one hands the meshes to the page.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..check.check import Certificate, check_mesh, read_for_check
from ..errors import SuperSdfError, check_modules
from ..files.output import naming, replacing
from ..grid.sdf_grid import cubic_grid
from ..options import Options
from ..surface.mesh import Mesh
from .meshes import coarse_surface, packed_mesh

RESULT, COARSE = "super-sdf", "marching cubes of the samples"
LONGEST_HEAD = 1 << 20  # bytes of a file's first line
COMMENT = b"// "
CALL = "superSdfMeshes"  # the function of ``page.js``
LISTS = ("facts", "certificate", "stages", "faults", "notes", "warnings", "remarks")
COUNTED = ("vertices", "triangles", "band_voxels", "decoded_voxels", "noisy_voxels", "tiles")
NOT_DRAWN = "not drawn: run the command again for its meshes"

Entry = dict[str, Any]
"""A file in the JSON of a page.

id : what its meshes are found by
name : what it is
status : "ok", "failed" or "waiting"; of a failed one ``reason``
line : counts in one line
seconds, residual : for sorting; None if unknown
facts, certificate, stages : lists of label and text
faults, notes, warnings, remarks : lists of sentences
meshes : "page", "beside" or None: where its meshes are
"""


@dataclass
class Item:
    """What a page shows of one result."""

    meshes: list[dict[str, Any]] = field(default_factory=list)  # packed: result, coarse mesh
    certificate: dict[str, Any] | None = None  # or, under "error", why there is none
    remarks: list[str] = field(default_factory=list)  # what is missing, and why
    made_of: str = ""  # the SHA-256 of the mesh file, if the item is kept in a file
    size: int = 0  # about how many bytes the meshes take in a page; of an item from a file

    def show(self, title: str, mesh: Mesh, certificate: Certificate | None = None) -> None:
        """Add a mesh, or a remark why it is not shown."""
        try:
            self.meshes.append(packed_mesh(title, mesh, certificate))
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
    item, checked = Item(), None
    try:
        check_modules("a check of the mesh, with residuals,", "report", ("igl",))
        certificate = certificate or check_mesh(shown, samples, options)
        item.certificate = certificate.report()
    except SuperSdfError as error:
        item.certificate = {"error": str(error)}
    item.show(RESULT, shown, certificate)
    lattice = cubic_grid(samples, options.offset)
    known = lattice.field.unseen is None  # beside what is unknown, a coarse surface is made up
    coarse = coarse_surface(lattice, options.offset) if known else None
    if coarse and len(coarse.faces):
        if certificate:
            checked = check_mesh(coarse, samples, options, intersections=False)
        title = COARSE + (", made equally spaced" if lattice.shape != samples.shape else "")
        item.show(title, coarse, checked)
    return item


def items_folder(page: Path) -> Path:
    """Return the folder beside a page for items: OUT-files beside OUT.html."""
    return page.with_name(f"{page.stem}-files")


def item_path(folder: Path, target: str) -> Path:
    """Return the file of the item of an output; its stem is the id that the page uses."""
    digest = hashlib.sha256(target.encode("utf-8", "surrogatepass")).hexdigest()
    return folder / f"{digest[:16]}.js"


def keep_item(item: Item, folder: Path, target: str, sha256: str) -> None:
    """Write the item of an output whose mesh file has this hash; the folder is made for it."""
    size, path = sum(len(mesh["data"]) for mesh in item.meshes), item_path(folder, target)
    head = json.dumps({**vars(item), "meshes": [], "size": size, "made_of": sha256})
    call = f"{CALL}({json.dumps(path.stem)}, {json.dumps(item.meshes)});"
    with naming(folder):
        folder.mkdir(exist_ok=True)
    with replacing(path) as part:
        part.write_bytes(COMMENT + f"{head}\n{call}\n".encode("ascii"))


def find_item(folder: Path, target: str, sha256: str) -> Item | None:
    """Return the item of an output without its meshes; None if there is none of this mesh."""
    try:
        with item_path(folder, target).open("rb") as file:
            line = file.readline(LONGEST_HEAD)
        item = Item(**json.loads(line.removeprefix(COMMENT)))
    except (OSError, ValueError, TypeError):  # missing, or damaged
        return None
    return item if item.made_of == sha256 else None


def entry_of(name: str, status: str = "ok", **known: Any) -> Entry:
    """Return an entry with what is known of a file; the rest is empty."""
    empty: Entry = {"id": "", "name": name, "status": status, "reason": "", "line": ""}
    empty |= dict.fromkeys(("seconds", "residual", "meshes")) | {key: [] for key in LISTS}
    return empty | known


def entry_of_report(name: str, report: Mapping[str, Any], item: Item | None) -> Entry:
    """Return the entry of a mesh by its report, as ``Conversion.report`` has it, and its item.

    ``report`` may also have ``seconds``, in all or per stage; ``stages``; ``check``, a certificate;
    and ``input``, ``output``, ``model`` and the like.
    """
    stages = report["stages"] if "stages" in report else report.get("seconds", {})
    certificate = report.get("check") or (item.certificate if item else None) or {}
    shape = " x ".join(map(str, report.get("shape", ())))
    said = [f"{report['triangles']:,} triangles"] if "triangles" in report else []
    said += ["closed" if report["closed"] else "open"] if "closed" in report else []
    facts = {
        "grid": report.get("input") or report.get("in"),
        "mesh": report.get("output"),
        "samples": shape,
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
        facts["simplified"] = (
            f"from {simplified['triangles_before']:,} triangles; largest distance "
            f"{off['largest']:.4f} voxels, {off['largest_back']:.4f} back; "
            f"a voxel is {simplified['voxel_size']:.6g}"
        )
    return entry_of(
        name,
        line=", ".join([*said, f"from {shape} samples"] if shape else said),
        seconds=report["seconds"] if "stages" in report else sum(stages.values()),
        residual=(certificate.get("residual") or {}).get("mean"),
        facts=[[label, str(text)] for label, text in facts.items() if text not in (None, "")],
        stages=[[stage, f"{spent:.2f} s"] for stage, spent in stages.items()],
        certificate=certificate_facts(certificate),
        faults=certificate.get("faults", []),
        notes=[*report.get("inferred", []), *report.get("notes", [])],
        warnings=list(report.get("warnings", [])),
        remarks=item.remarks if item else [NOT_DRAWN],
    )


def certificate_facts(found: Mapping[str, Any]) -> list[list[str]]:
    """Return what a certificate says, label by label; or why there is none."""
    if "error" in found:
        return [["not checked", found["error"]]]
    if not found:
        return []
    surface, residual = found["surface"], found["residual"]
    kinds, pairs = ("closed", "oriented", "manifold"), surface["self_intersections"]
    facts = {"checked": f"{found['samples']['exact']:,} exact samples near the surface"}
    if residual:
        facts["mean residual"] = f"{residual['mean']:.4f} voxels"
        facts["99th percentile"] = f"{residual['p99']:.4f} voxels"
        facts["largest residual"] = f"{residual['largest_signed']:+.4f} voxels"
        facts["above 0.1 voxel"] = f"{residual['share_above_tenth']:.2%} of the samples"
    else:
        facts["residual"] = "unknown, since no sample is exact"
    facts["surface"] = ", ".join(("" if surface[kind] else "not ") + kind for kind in kinds)
    facts["self-intersections"] = "not counted" if pairs is None else f"{pairs:,}"
    facts["components"] = f"{surface['components']:,}"
    facts["volume, area"] = f"{surface['volume']:.6g}, {surface['area']:.6g}"
    return [[label, text] for label, text in facts.items()]


def numbers(values: Iterable[float]) -> str:
    """Return coordinates with commas, to six digits."""
    return ", ".join(f"{value:.6g}" for value in values)
