"""What a page shows of each result: its entry, labels and texts, and its item, all the rest.

The file of an item is a script, since a page that was opened from a file may load nothing else. Its
first line is a comment with all but the meshes, so that a page of many files is made without
reading these; the second one hands the meshes to the page.

Meshes are compressed, in base64: differences of consecutive x, then y, then z, in steps of 1/65535
of their box, modulo 2^16; of consecutive corners of the triangles, modulo 2^32; then a signed byte
for each residual, 127 for ``FULL`` voxels, -128 if unknown. ``viewer.js`` unpacks them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..check import FULL, Certificate, check_mesh
from ..errors import SuperSdfError, check_modules
from ..files.output import naming, replacing
from ..surface.extract import coarse_surface
from ..surface.mesh import Mesh
from ..truth import merged

if TYPE_CHECKING:
    from ..options import Options

MOST_TRIANGLES = 500_000  # of a mesh in a page: 3 to 5 MB
STEPS = 65535  # along the longest side of the box
RESULT, COARSE = "super-sdf", "marching cubes of the samples"
COMMENT = b"// "
CALL = "superSdfMeshes"  # the function of ``page.js``
LISTS = ("facts", "certificate", "stages", "faults", "notes", "warnings", "remarks")
COUNTED = ("vertices", "triangles", "band_voxels", "noisy_voxels", "tiles")
NOT_DRAWN = "not drawn: run the command again for its meshes"

Entry = dict[str, Any]
"""A file in the JSON of a page: ``id``, by which its meshes are found, and ``name``; ``status``,
"ok", "failed" or "waiting", and the ``reason`` of a failure; ``line``, counts in one line;
``seconds`` and ``residual``, for sorting, None if unknown; lists of label and text, or of
sentences, see ``LISTS``; ``meshes``, where they are: "page", a file beside it, or None.
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
            self.remarks.append(f"not shown: {error.flagged}")


def item_of(made: Any, options: Options, certificate: Certificate | None = None) -> Item:
    """Return the item of a conversion; errors are in it."""
    shown, samples = merged(made.mesh), made.grid
    try:
        check_modules("a check of the mesh, with residuals,", "report", ("igl",))
        certificate = certificate or check_mesh(shown, samples, options)
        item = Item(certificate=certificate.report())
    except SuperSdfError as error:
        item = Item(certificate={"error": error.flagged})
    item.show(RESULT, shown, certificate)
    known = samples.field.unseen is None  # beside what is unknown, a coarse surface is made up
    coarse = coarse_surface(samples, options.offset) if known else None
    if coarse and len(coarse.faces):
        checked = certificate and check_mesh(coarse, samples, options)
        as_it_is = samples.is_cubic or samples.field.own_lattice
        item.show(COARSE + ", made equally spaced" * (not as_it_is), coarse, checked)
    return item


def packed_mesh(title: str, mesh: Mesh, certificate: Certificate | None = None) -> dict[str, Any]:
    """Return a mesh in the JSON of a page, simplified if large; with residuals, if known."""
    caption = f"{title}: {len(mesh.faces):,} triangles"
    if len(mesh.faces) > MOST_TRIANGLES:  # in one pass, unlike ``simplify_mesh``: only to be seen
        check_modules(f"a view of more than {MOST_TRIANGLES:,} triangles", "simplify", ("pyfqmr",))
        from ..simplify.collapsing import collapse_edges
        from ..simplify.walls import Walls

        held, side = np.zeros(len(mesh.vertices), bool), (mesh.area() / len(mesh.faces)) ** 0.5
        mesh = collapse_edges(Walls.of(mesh), held, side, MOST_TRIANGLES)[0]
        caption += f", shown simplified to {len(mesh.faces):,}"
    vertices = mesh.vertices.astype(np.float64)
    low, high = (vertices.min(0), vertices.max(0)) if len(vertices) else np.zeros((2, 3))
    step = float((high - low).max()) / STEPS or 1.0
    places = np.rint((vertices - low) / step).astype("<u2")
    flat = places.T.ravel(), mesh.faces.astype("<u4").ravel()
    parts = [np.diff(each, prepend=each.dtype.type(0)) for each in flat]
    if shaded := certificate is not None and len(certificate.values) > 0:
        share = certificate.residuals_at(mesh.vertices) / FULL
        known = np.rint(np.clip(share, -1, 1) * 127)
        parts.append(np.where(np.isnan(share), -128, known).astype(np.int8))
    data = zlib.compress(b"".join(part.tobytes() for part in parts), 6)
    counts = {"vertices": len(vertices), "triangles": len(mesh.faces), "residuals": shaded}
    placed = {"low": low.tolist(), "step": step, "data": base64.b64encode(data).decode("ascii")}
    return {"caption": caption, **counts, **placed}


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
            line = file.readline()
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
    """Return the entry of a mesh by its report, as ``upsample --json`` or ``batch`` has it."""
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
        "mesher": report.get("asked", {}).get("mesher"),
        **{key: report.get(key) for key in ("factor", "model", "precision", "device", "version")},
        **{key.replace("_", " "): f"{report[key]:,}" for key in COUNTED if key in report},
        "bounds": " to ".join(f"({numbers(corner)})" for corner in report.get("bounds", ())),
    }
    if simplified := report.get("simplified"):
        count, off = simplified["triangles_before"], simplified["deviation"]["largest"]
        facts["simplified"] = f"from {count:,} triangles, by {off:.4f} voxels at most"
    return entry_of(
        name,
        line=", ".join([*said, f"from {shape} samples"] if shape else said),
        seconds=report["seconds"] if "stages" in report else sum(stages.values()) or None,
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
    if "error" in found or not found:
        return [["not checked", why] for why in found.values()]
    surface, residual = found["surface"], found["residual"]
    kinds = "closed", "oriented", "manifold"
    facts = {"checked": f"{found['samples']['exact']:,} exact samples near the surface"}
    if residual:
        facts["mean residual"] = f"{residual['mean']:.4f} voxels"
        facts["99th percentile"] = f"{residual['p99']:.4f} voxels"
        facts["largest residual"] = f"{residual['largest_signed']:+.4f} voxels"
        facts["above 0.1 voxel"] = f"{residual['share_above_tenth']:.2%} of the samples"
    else:
        facts["residual"] = "unknown, since no sample is exact"
    facts |= {
        "surface": ", ".join(("" if surface[kind] else "not ") + kind for kind in kinds),
        "self-intersections": f"{surface['self_intersections']:,}",
        "components": f"{surface['components']:,}",
        "volume, area": f"{surface['volume']:.6g}, {surface['area']:.6g}",
    }
    return list(map(list, facts.items()))


def numbers(values: Iterable[float]) -> str:
    """Return coordinates with commas, to six digits."""
    return ", ".join(f"{value:.6g}" for value in values)
