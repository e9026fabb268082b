"""Measure what README, the documents and the model cards quote; write it to lab/figures/NAME.json.

    python -m export.parts PARTS
    python -m lab figures --shapes FOLDER --parts PARTS
    python -m lab figures --shapes FOLDER --only quality noise
    python -m lab figures --shapes FOLDER --only quality --network new.onnx --out new/

Every measurement is kept in OUT/rows.jsonl as it comes, by what it depends on (mesh, setting,
method, network, code, and for times the machine), so a run that was killed goes on where it was.
``python -m lab documents`` writes the tables into the documents.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from super_sdf.errors import FileError, OptionError
from super_sdf.files.output import replacing
from super_sdf.network.network import find_model
from super_sdf.options import DEFAULT_QUALITY, QUALITIES
from super_sdf.threads import count_cores

from . import costs, parser_of, quoted
from .costs import machine
from .evaluate import Results, add_jobs, progress_lines, results_of, tasks_of
from .kinds import KINDS
from .measuring import Task, digest_of_ours
from .methods import FLOOR, ON
from .ndc import add_ndc
from .rows import Row, Rows
from .shapes import Setting, find_meshes, spread
from .tables import GAPS, gap_closed, mean_of, summary

FOLDER = Path(__file__).parent / "figures"
ROWS = "rows.jsonl"
FEW = 10  # shapes of the smaller figures, spread over all
BASELINES = ("mc", "mc-lewiner", "trilinear", "bspline")
# Networks are compared by marching cubes of their fields, as the bound is made.
MODELS = ("@fast", "@noisy", "", "@base:float32", "@best")
NETWORKS = ("ours", *(f"ours-marching{model}" for model in MODELS))
LATE, FEW_PARTS = 900.0, 6  # seconds for another method on a part, and parts


@dataclass(frozen=True)
class Bench:
    """What the figures are measured on, and how."""

    shapes: tuple[Path, ...]  # for validation
    parts: tuple[Path, ...]  # CAD parts of ``export.parts``
    rows: Rows
    network: str = DEFAULT_QUALITY  # of the method ``ours``
    sizes: tuple[int, ...] = (32, 64, 128)  # of the main tables
    jobs: int = 1  # processes at a time
    runs: int = 5  # of each that is timed

    @property
    def small(self) -> int:
        """The size of the smaller figures."""
        return self.sizes[0]

    @property
    def few(self) -> tuple[Path, ...]:
        """Some of the shapes."""
        return spread(self.shapes, FEW)

    def measured(
        self,
        name: str,
        settings: Sequence[Setting],
        methods: Sequence[str],
        limit: float | None = None,
    ) -> Results:
        """Return the measurements of methods on a set, "parts", "few" or "validation", in settings.

        What is missing is measured. Parts are turned.
        """
        paths = {"parts": self.parts, "few": self.few}.get(name, self.shapes)
        paths = paths[:FEW_PARTS] if limit else paths
        if not paths:
            raise OptionError("the CAD parts are needed: make them, python -m export.parts PARTS, "
                              "and give --parts PARTS")  # fmt: skip
        threads, turned = max(1, count_cores() // max(self.jobs, 1)), 0 if name == "parts" else None
        like = Task(paths[0], settings[0], tuple(methods), self.network, threads=threads,
                    turned=turned, limit=limit)  # fmt: skip
        return results_of(tasks_of(paths, settings, like), self.rows, self.jobs, progress_lines())

    def kept(self, key: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> Row:
        """Return the row of a key with the code and the network; measure it if there is none."""
        key = {**key, "digest": digest_of_ours(self.network)}
        if not self.rows.is_final(key):
            print(", ".join(map(str, key.values())), file=sys.stderr, flush=True)
            self.rows.add(key, {**measure(), "error": None})
        return self.rows.get(key) or {}

    def timed(self, key: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> Row:
        """Return a row as ``kept`` does; it counts for this machine and its versions only."""
        return self.kept({**key, "machine": str(machine())}, measure)


def name_of(method: str) -> str:
    """Return the word for a method in a figure: "ours" is default, "ours-marching" base."""
    name, _, model = method.partition("@")
    if name == "ours-marching":
        return model.replace(":", "-") or "base"
    return "default" if name == "ours" else name


# The figures: each takes the bench and returns rows, with words that tell them apart.


def quality(bench: Bench) -> list[Row]:
    """Measure all methods on all shapes at all sizes."""
    methods = [*BASELINES, *NETWORKS, "bound"]
    if bench.network != DEFAULT_QUALITY:  # the others do not change with it
        methods = [*BASELINES, "ours", "ours-marching", "bound"]
    results = bench.measured("validation", [Setting(n) for n in bench.sizes], methods)
    rows = []
    for size in bench.sizes:
        found = {m: results.of(Setting(size), m) for m in (*methods, FLOOR)}
        three = found["bspline"], found["bound"]
        for method, measured in found.items():
            gaps = {f"gap_{key}": gap_closed(measured, *three, key) for key in GAPS}
            rows.append({"size": size, "method": name_of(method), **summary(measured), **gaps})
    return rows


def edges(bench: Bench) -> list[Row]:
    """Measure the meshers, on CAD parts and on the validation shapes."""
    rows = []
    small, sizes = bench.small, bench.sizes[:2]
    both = ("ours-marching", "ours", "bound", "bound-sharp")
    plans = (
        *(("parts", n, 4, (*both, *(f"ours/{k}" for k in (4, 16)))) for n in sizes),
        ("parts", small, 2, ("ours",)),
        *(("validation", n, 4, both) for n in sizes),
    )
    for name, size, factor, methods in plans:
        setting = Setting(size, factor)
        results = bench.measured(name, [setting], methods)
        for method in methods:
            word = method.replace("ours-marching", "marching").replace("ours", "sharp")
            word += f"-{factor}" if factor != 4 else ""
            words = {"set": name, "size": size, "method": word}
            rows.append({**words, **summary(results.of(setting, method))})
    return rows


def peers(bench: Bench) -> list[Row]:
    """Measure dual contouring of distances and NDC, and ours with as many triangles."""
    other = "dual-contouring"
    methods, setting = (other, f"ours-marching/{other}", f"ours/{other}"), Setting(bench.small)
    results = bench.measured("parts", [setting], methods, LATE)
    rows: list[Row] = [{"method": m, **summary(results.of(setting, m))} for m in methods]
    settings = [Setting(size) for size in bench.sizes[:2]]
    methods = "ndc", "ours-marching/ndc", "ours/ndc"
    results = bench.measured("parts", settings, methods)
    for setting in settings:
        for m in methods:
            rows.append({"method": m, "size": setting.size, **summary(results.of(setting, m))})
    return rows


def kinds(bench: Bench) -> list[Row]:
    """Measure grids that are not exact distances, by us and by what people do today."""
    rows, setting = [], Setting(bench.small)
    masks = {name: kind for name, kind in KINDS.items() if kind.group == "mask"}
    sets = {"shapes": ("few", KINDS), **({"parts": ("parts", masks)} if bench.parts else {})}
    for name, (paths, some) in sets.items():
        methods = [f"{method}{ON}{kind}" for kind in some for method in some[kind].methods]
        results = bench.measured(paths, [setting], methods)
        for title in dict.fromkeys(kind.title for kind in some.values()):
            rows += kind_rows(results, setting, name, title)
    return rows


def kind_rows(results: Results, setting: Setting, name: str, title: str) -> list[Row]:
    """Return a row for each method on the kinds of a title; refused grids are left out of all."""
    alike = [kind for kind in KINDS.values() if kind.title == title]
    by_method = {
        method: [row for kind in alike for row in results.of(setting, f"{method}{ON}{kind.name}")]
        for method in alike[0].methods
    }
    taken = [not row.get("refused") for row in by_method["ours"]]
    words = {"set": name, "kind": title, "size": setting.size}
    rows = []
    for method, measured in by_method.items():
        used = [row for row, good in zip(measured, taken) if good]
        far = [setting.size * row["p2s"] for row in used] or [np.nan]
        off = [100 * abs(row["volume_off"]) for row in used] or [np.nan]
        row = {**words, "method": method, "grids": len(used), "voxels": float(np.mean(far))}
        row |= {"largest": max(far), "volume": float(np.mean(off)), "volume_most": max(off)}
        row |= {key: mean_of(used, key) for key in ("f1", "nc")}
        row |= {key: sum(one[key] for one in used) for key in ("pieces", "closed")}
        row["pieces_of_reference"] = sum(one["pieces_of_reference"] for one in used)
        if method == "ours":
            kinds_of = Counter(one["taken_as"] for one in used).most_common()
            several = len(kinds_of) > 1
            row["taken_as"] = ", ".join(f"{k} {n}" if several else k for k, n in kinds_of)
            row |= {"refused": taken.count(False), "told": sum(bool(r.get("told")) for r in used)}
        rows.append(row)
    return rows


def noise(bench: Bench) -> list[Row]:
    """Measure uniform noise, in percent of half a voxel."""
    methods = ("mc", "bspline", "ours")
    settings = {p: Setting(bench.small, noise=p / 100) for p in (0, 20, 50, 100)}
    return few_rows(bench, "noise", settings, methods)


def scale(bench: Bench) -> list[Row]:
    """Measure shapes that fill a part of the grid."""
    settings = {s: Setting(bench.small, scale=s) for s in (0.25, 0.5, 0.75)}
    return few_rows(bench, "scale", settings, ("mc", "bspline", "ours", "bound"))


def factors(bench: Bench) -> list[Row]:
    """Measure the upscaling factors."""
    settings = {f: Setting(bench.small, f) for f in (2, 4, 8, 16)}
    return few_rows(bench, "factor", settings, ("mc", "bspline", "ours", "bound"))


def few_rows(
    bench: Bench, word: str, settings: Mapping[Any, Setting], methods: Sequence[str]
) -> list[Row]:
    """Return a row for each setting and method, on some of the shapes."""
    results = bench.measured("few", list(settings.values()), methods)
    rows = []
    for value, setting in settings.items():
        found = results.by_method(setting, methods)
        for method, measured in found.items():
            gap = gap_closed(measured, found["bspline"], found.get("bound", []), "f1")
            words = {word: value, "method": name_of(method)}
            rows.append({**words, **summary(measured), "gap_f1": gap})
    return rows


def simplify(bench: Bench) -> list[Row]:
    """Measure meshes simplified within .02 voxel."""
    rows, setting = [], Setting(bench.small)
    methods = ("ours-marching", "ours-marching/within", "ours", "ours/within")
    for name in ("parts", "validation"):
        results = bench.measured(name, [setting], methods)
        for method in methods:
            mesher = "marching" if "marching" in method else "sharp"
            words = {"set": name, "mesher": mesher, "simplified": "within" in method}
            rows.append({**words, **summary(results.of(setting, method))})
    return rows


# How each is measured, and by which networks.
FIGURES: dict[str, tuple[Callable[[Bench], list[Row]], tuple[str, ...]]] = {
    "quality": (quality, ("fast", "base", "best", "noisy")),
    "edges": (edges, ("base",)),
    "kinds": (kinds, ("base", "mask", "noisy")),
    "noise": (noise, ("base", "noisy")),
    "scale": (scale, ("base",)),
    "factors": (factors, ("base",)),
    "simplify": (simplify, ("base",)),
    "speed": (costs.speed_rows, ("fast", "base", "best", "mask", "noisy")),
    "peers": (peers, ("base",)),
}
RARE = ("peers",)  # takes long for what few ask for


def digests(networks: Iterable[str], chosen: str) -> dict[str, str]:
    """Return the SHA-256 of the files of networks, the int8 ones that the CPU runs."""
    found = {}
    for name in networks:
        model = chosen if name == DEFAULT_QUALITY else QUALITIES.get(name, (name, 1))[0]
        found[name] = hashlib.sha256(find_model(model, "auto")[0].read_bytes()).hexdigest()[:12]
    return found


def commit() -> str:
    """Return the commit of the sources; "unknown" outside of a clone."""
    words = ["git", "-C", str(FOLDER.parent), "rev-parse", "--short=9", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True).stdout.strip() or "unknown"


def write(name: str, rows: list[Row], bench: Bench, out: Path) -> Path:
    """Write a figure's file."""
    content = {
        "name": name,
        "networks": digests(FIGURES[name][1], bench.network),
        "commit": commit(),
        "machine": machine(),
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "shapes": len(bench.shapes),
        "rows": [{key: rounded(value) for key, value in row.items()} for row in rows],
    }
    path = out / f"{name}.json"
    with replacing(path) as part:
        part.write_text(json.dumps(content, indent=1) + "\n")
    return path


def rounded(value: Any) -> Any:
    """Return a number with six digits, so that a file holds what a table could show."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if np.isfinite(value) else None


def main() -> None:
    """Measure the figures, write their files, and print their tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--shapes", type=Path, nargs="+", required=True, help="meshes, or folders")
    parser.add_argument("--parts", type=Path, nargs="*", default=[], help="CAD parts")
    parser.add_argument("--only", nargs="+", choices=FIGURES, metavar="NAME",
                        help=f"some of {', '.join(FIGURES)}")  # fmt: skip
    parser.add_argument("--network", default=DEFAULT_QUALITY, help="ONNX file in place of base")
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128])
    parser.add_argument("--count", type=int, help="use only this many shapes, spread over all")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each")
    add_jobs(parser)
    add_ndc(parser)
    words = parser.parse_args()
    if words.network != DEFAULT_QUALITY and words.out == FOLDER:
        raise OptionError("--network measures another network: give it its own folder, --out")
    for size in words.sizes:
        Setting(size).check()
    try:
        words.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{words.out} cannot be made: {error.strerror}") from error
    shapes, parts = (find_meshes(given) for given in (words.shapes, words.parts))
    bench = Bench(
        spread(shapes, words.count or len(shapes)),
        spread(parts, words.count or len(parts)),
        Rows(words.out / ROWS),
        words.network,
        tuple(words.sizes),
        words.jobs,
        words.runs,
    )
    for name in words.only or [name for name in FIGURES if name not in RARE]:
        path = write(name, FIGURES[name][0](bench), bench, words.out)
        for table, text in quoted.tables_of(path).items():
            print(f"{table}\n\n{text}\n", flush=True)
