"""What a page says of each file, as labels and texts, from its report and its certificate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from .items import Item

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
LISTS = ("facts", "certificate", "stages", "faults", "notes", "warnings", "remarks")
NUMBERS = ("seconds", "residual", "thumbnail", "meshes")
COUNTED = ("vertices", "triangles", "band_voxels", "decoded_voxels", "noisy_voxels", "slabs")
NOT_DRAWN = "not drawn: run the command again for its picture and its meshes"


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
    """Return triangles and grid in one line, as far as they are known."""
    said = [f"{report['triangles']:,} triangles"] if "triangles" in report else []
    if "closed" in report:
        said.append("closed" if report["closed"] else "open")
    if "shape" in report:
        said.append(f"from {_by(report['shape'])} samples")
    return ", ".join(said)


def _facts(report: Mapping[str, Any]) -> list[list[str]]:
    """Return what is known of a conversion, label by label."""
    texts = {
        "grid": report.get("input") or report.get("in"),
        "mesh": report.get("output"),
        "samples": _by(report.get("shape", ())),
        "spacing": numbers(report.get("spacing", ())),
        "origin": numbers(report.get("origin", ())),
        "values": (report.get("field") or {}).get("kind"),
        **{key: report.get(key) for key in ("factor", "mesher", "model", "precision", "device")},
        **{key.replace("_", " "): f"{report[key]:,}" for key in COUNTED if key in report},
        "bounds": " to ".join(f"({numbers(corner)})" for corner in report.get("bounds", ())),
    }
    if simplified := report.get("simplified"):
        off = simplified["deviation"]
        texts["simplified"] = (
            f"from {simplified['triangles_before']:,} triangles; largest distance "
            f"{off['largest']:.4f} voxels, {off['largest_back']:.4f} back"
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


def _by(shape: Iterable[int]) -> str:
    """Return the size of a grid, such as 64 x 64 x 64."""
    return " x ".join(map(str, shape))


def numbers(values: Iterable[float]) -> str:
    """Return coordinates with commas, to six digits."""
    return ", ".join(f"{value:.6g}" for value in values)
