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


def entry_of(name: str, status: str = "ok", **known: Any) -> Entry:
    """Return an entry with what is known of a file; the rest is empty."""
    empty: Entry = {"id": "", "name": name, "status": status, "reason": "", "line": ""}
    empty |= dict.fromkeys(NUMBERS) | {key: [] for key in LISTS}
    return empty | known


def entry_of_report(name: str, report: Mapping[str, Any], item: Item | None) -> Entry:
    """Return the entry of a mesh by its report, as ``Conversion.report`` has it, and its item.

    ``report`` may also have ``seconds``, in all or per stage; ``stages``; ``check``, a certificate;
    and ``input``, ``output``, ``model`` and the like.
    """
    stages = report["stages"] if "stages" in report else report.get("seconds", {})
    total = report["seconds"] if "stages" in report else sum(stages.values())
    certificate = report.get("check") or (item.certificate if item else None) or {}
    return entry_of(
        name,
        line=counts_line(report),
        seconds=total,
        residual=(certificate.get("residual") or {}).get("mean"),
        facts=facts(report),
        stages=[[stage, f"{spent:.2f} s"] for stage, spent in stages.items()],
        certificate=certificate_facts(certificate),
        faults=certificate.get("faults", []),
        notes=[*report.get("inferred", []), *report.get("notes", [])],
        warnings=list(report.get("warnings", [])),
        **what_is_shown(item),
    )


def what_is_shown(item: Item | None) -> Entry:
    """Return the part of an entry that an item gives."""
    if item is None:
        return {"remarks": ["not drawn: run the command again for its picture and its meshes"]}
    return {"thumbnail": item.thumbnail, "remarks": item.remarks}


def counts_line(report: Mapping[str, Any]) -> str:
    """Return triangles and grid in one line, as far as they are known."""
    said = [f"{report['triangles']:,} triangles"] if "triangles" in report else []
    if "closed" in report:
        said.append("closed" if report["closed"] else "open")
    if "shape" in report:
        said.append(f"from {by(report['shape'])} samples")
    return ", ".join(said)


def facts(report: Mapping[str, Any]) -> list[list[str]]:
    """Return what is known of a conversion, label by label."""
    texts = {
        "grid": report.get("input") or report.get("in"),
        "mesh": report.get("output"),
        "samples": by(report["shape"]) if "shape" in report else None,
        "spacing": numbers(report.get("spacing", ())),
        "origin": numbers(report.get("origin", ())),
        "values": (report.get("field") or {}).get("kind"),
        **{key: report.get(key) for key in ("factor", "mesher", "model", "precision", "device")},
        **{key.replace("_", " "): count(report.get(key)) for key in COUNTED},
        "bounds": " to ".join(f"({numbers(corner)})" for corner in report.get("bounds", ())),
        "simplified": simplified(report.get("simplified")),
    }
    return [[label, str(text)] for label, text in texts.items() if text not in (None, "")]


def simplified(found: Mapping[str, Any] | None) -> str:
    """Return how much simpler the mesh file is than the mesh that was made."""
    if not found:
        return ""
    off = found["deviation"]
    return (
        f"from {found['triangles_before']:,} triangles; largest distance {off['largest']:.4f} "
        f"voxels, {off['largest_back']:.4f} back"
    )


def tiles(entry: Entry) -> list[list[str]]:
    """Return the figures for the head of a page of one file."""
    shown = [row for row in entry["certificate"] if row[0] in ("mean residual", "largest residual")]
    faults = [["faults", str(len(entry["faults"]) or "none")]] if shown else []
    said = {"result": entry["line"], "time": f"{entry['seconds']:.1f} s"}
    return [*([label, text] for label, text in said.items() if text), *shown, *faults]


def certificate_facts(found: Mapping[str, Any]) -> list[list[str]]:
    """Return what a certificate says, label by label; or why there is none."""
    if "error" in found:
        return [["not checked", found["error"]]]
    if not found:
        return []
    surface, residual = found["surface"], found.get("residual")
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
    rows += [
        ["surface", ", ".join(qualities(surface))],
        ["components", f"{surface['components']:,}"],
        ["self-intersections", count(surface["self_intersections"]) or "not counted"],
        ["volume", f"{surface['volume']:.6g}"],
        ["area", f"{surface['area']:.6g}"],
    ]
    return rows


def qualities(surface: Mapping[str, Any]) -> list[str]:
    """Return whether a surface is closed, oriented and a manifold, in words."""
    return [("" if surface[key] else "not ") + key for key in ("closed", "oriented", "manifold")]


def count(number: int | None) -> str | None:
    """Return a count with separators; None if it is not known."""
    return None if number is None else f"{number:,}"


def by(shape: Iterable[int]) -> str:
    """Return the size of a grid, such as 64 x 64 x 64."""
    return " x ".join(map(str, shape))


def numbers(values: Iterable[float]) -> str:
    """Return coordinates with commas, to six digits."""
    return ", ".join(f"{value:.6g}" for value in values)
