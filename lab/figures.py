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

import csv
import datetime
import json
import statistics
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from super_sdf.errors import OptionError, SuperSdfError
from super_sdf.files.output import replacing
from super_sdf.network.network import find_model
from super_sdf.options import DEFAULT_QUALITY, QUALITIES
from super_sdf.threads import count_cores

from . import costs, parser_of
from .documents import FOLDER, tables_of
from .evaluate import Results, add_jobs, progress_lines, results_of
from .kinds import KINDS
from .masks import PEERS, RATIOS, measure, scenes
from .measuring import Task, digest_of_file, digest_of_ours
from .methods import FLOOR, ON
from .ndc import add_ndc
from .rows import Row, Rows
from .shapes import Setting, Shape, find_meshes, spread
from .tables import gaps_closed, mean_of, summary

ROWS = "rows.jsonl"
CHOICE = Path(__file__).with_name("validation.csv")  # the shapes, and which networks are chosen on
FEW, FEW_PARTS, TIMED = 10, 6, 4  # shapes and parts of the smaller figures, and of times
# Networks are compared by marching cubes of their fields, as the bound is made.
NETWORKS = [f"ours-marching{model}" for model in ("@fast", "@noisy", "@base:float32", "@best")]
LARGE, LIMITS = 512, ("4G", "1500M", "900M")  # samples a side of a torus, and memory limits
OPTIONS = ("", "--quality fast", "--quality best", "--precision float32", "--mesher marching",
           "--simplify 0.02")  # fmt: skip
DENSE = {"zoom-cubic": 3, "zoom-linear": 1}  # orders of SciPy's zoom
Words = Mapping[str, Any]


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

    def results(self, name: str, settings: Sequence[Setting], methods: Sequence[str]) -> Results:
        """Return the measurements of methods on a set, in settings; measure what is missing.

        Sets are "validation", "few" of them, "parts", which are turned, and "few parts".
        """
        paths = {"parts": self.parts, "few parts": self.parts[:FEW_PARTS],
                 "few": spread(self.shapes, FEW)}.get(name, self.shapes)  # fmt: skip
        if not paths:
            raise OptionError("the CAD parts are needed: make them, python -m export.parts PARTS, "
                              "and give --parts PARTS")  # fmt: skip
        threads, turned = max(1, count_cores() // max(self.jobs, 1)), 0 if "parts" in name else None
        methods = tuple(method for method in methods if method != FLOOR)
        like = Task(paths[0], settings[0], methods, self.network, threads=threads,
                    turned=turned)  # fmt: skip
        return results_of(paths, settings, like, self.rows, self.jobs, progress_lines())

    def measured(
        self, name: str, settings: Sequence[tuple[Words, Setting]], methods: Sequence[str]
    ) -> list[Row]:
        """Return the means of each method in each setting, a row of its words."""
        results = self.results(name, [setting for _, setting in settings], methods)
        rows = []
        for words, setting in settings:
            found = {method: results.of(setting, method) for method in methods}
            ends = found.get("bspline", []), found.get("bound", [])
            for method, some in found.items():
                gaps = gaps_closed(some, *ends)
                rows.append({**words, "method": method, **summary(some), **gaps})
        return rows

    def timed(self, key: Words, measure: Callable[[], Words]) -> Row:
        """Return a row, measured if there is none by the code, the network and this machine."""
        key = {**key, "machine": str(costs.machine()), "digest": digest_of_ours(self.network)}
        if not self.rows.is_final(key):
            print(", ".join(map(str, key.values())), file=sys.stderr, flush=True)
            self.rows.add(key, {**measure(), "error": None})
        return self.rows.get(key) or {}


# The figures: each takes the bench and returns rows, with words that tell them apart.


def quality(bench: Bench) -> list[Row]:
    others = NETWORKS if bench.network == DEFAULT_QUALITY else []  # they do not change with it
    baselines = ("mc", "mc-lewiner", "trilinear", "bspline")
    methods = [*baselines, "ours", "ours-marching", *others, "bound", FLOOR]
    return bench.measured("validation", [({"size": n}, Setting(n)) for n in bench.sizes], methods)


def halves(bench: Bench) -> list[Row]:
    """Return the gaps closed on shapes that networks were chosen on, and on the others."""
    with CHOICE.open(newline="") as file:
        chosen = {row["name"] for row in csv.DictReader(file) if row["chosen_on"] == "yes"}
    methods, rows = ("bspline", "ours-marching", "ours", "bound"), []
    settings = [Setting(n) for n in bench.sizes]
    results = bench.results("validation", settings, methods)
    for setting, (half, of_chosen) in product(settings, (("chosen on", True), ("others", False))):
        found = {
            method: [row for row in results.of(setting, method)
                     if (row["shape"] in chosen) == of_chosen]
            for method in methods
        }  # fmt: skip
        for method in methods[1:-1]:
            gaps = gaps_closed(found[method], found["bspline"], found["bound"])
            words = {"size": setting.size, "shapes": half, "method": method}
            rows.append({**words, "count": len(found[method]), **gaps})
    return rows


def edges(bench: Bench) -> list[Row]:
    """Measure the meshers, on CAD parts and on the validation shapes."""
    rows = []
    both = ("ours-marching", "ours", "bound", "bound-sharp")
    sizes = bench.sizes[:2]
    plans = (
        *(("parts", n, 4, (*both, "ours/4", "ours/16")) for n in sizes),
        ("parts", bench.sizes[0], 2, ("ours",)),
        *(("validation", n, 4, both) for n in sizes),
    )
    for name, size, factor, methods in plans:
        words = {"set": name, "size": size, "factor": factor}
        rows += bench.measured(name, [(words, Setting(size, factor))], methods)
    return rows


def peers(bench: Bench) -> list[Row]:
    """Measure dual contouring of distances and NDC, and ours with as many triangles."""
    rows = []
    for peer, name, sizes in (("dual-contouring", "few parts", 1), ("ndc", "parts", 2)):
        settings = [({"size": n}, Setting(n)) for n in bench.sizes[:sizes]]
        methods = peer, f"ours-marching/{peer}", f"ours/{peer}"
        rows += bench.measured(name, settings, methods)
    return rows


def kinds(bench: Bench) -> list[Row]:
    setting = Setting(bench.sizes[0])
    methods = [f"{method}{ON}{name}" for name, kind in KINDS.items() for method in kind.methods]
    results = bench.results("few", [setting], methods)
    titles = dict.fromkeys(kind.title for kind in KINDS.values())
    return [row for title in titles for row in kind_rows(results, setting, title)]


def kind_rows(results: Results, setting: Setting, title: str) -> list[Row]:
    """Return a row for each method on the kinds of a title; refused grids are left out of all."""
    alike = [kind for kind in KINDS.values() if kind.title == title]
    by_method = {
        method: [row for kind in alike for row in results.of(setting, f"{method}{ON}{kind.name}")]
        for method in alike[0].methods
    }
    taken = [not row.get("refused") for row in by_method["ours"]]
    rows = []
    for method, measured in by_method.items():
        used = [row for row, good in zip(measured, taken) if good]
        off = [100 * abs(row["volume_off"]) for row in used] or [np.nan]
        row = {"kind": title, "size": setting.size, "method": method}
        row |= {"voxels": setting.size * (mean_of(used, "p2s") or np.nan), "volume_most": max(off)}
        counted = ("pieces", "pieces_of_reference", "closed")
        row |= {"grids": len(used), **{key: sum(one[key] for one in used) for key in counted}}
        if method == "ours":
            kinds_of = Counter(one["taken_as"] for one in used).most_common()
            several = len(kinds_of) > 1
            row["taken_as"] = ", ".join(f"{k} {n}" if several else k for k, n in kinds_of)
            row["refused"] = taken.count(False)
        rows.append(row)
    return rows


def masks(bench: Bench) -> list[Row]:
    """Measure masks and labels beside other tools: means over the scenes of a set."""
    found = defaultdict[tuple[str, int, str], list[Row]](list)
    for scene, ratio, method in product(scenes(bench.shapes, bench.parts), RATIOS, PEERS):
        key = {"scene": scene.name, "ratio": ratio, "method": method}
        row = bench.timed(key, partial(measure, scene, method, ratio))
        for name in (scene.set,) if scene.set == "labels" else ("all masks", scene.set):
            found[name, ratio, method].append(row)
    rows = []
    for (name, ratio, method), some in found.items():
        numbers = [key for key, value in some[0].items() if isinstance(value, (int, float))]
        row = {key: mean_of(some, key) for key in numbers} | {"set": name, "ratio": ratio}
        closed = f"{sum(not row['open'] for row in some)} of {len(some)}"
        rows.append({**row, "method": method, "closed": closed})
    return rows


def noise(bench: Bench) -> list[Row]:
    shares = [({"noise": p}, Setting(bench.sizes[0], noise=p / 100)) for p in (0, 20, 50, 100)]
    return bench.measured("few", shares, ("mc", "bspline", "ours"))


def scale(bench: Bench) -> list[Row]:
    scales = [({"scale": s}, Setting(bench.sizes[0], scale=s)) for s in (0.25, 0.5, 0.75)]
    return bench.measured("few", scales, ("mc", "bspline", "ours", "bound"))


def factors(bench: Bench) -> list[Row]:
    some = [({"factor": f}, Setting(bench.sizes[0], f)) for f in (2, 4, 8, 16)]
    return bench.measured("few", some, ("mc", "bspline", "ours", "bound"))


def simplify(bench: Bench) -> list[Row]:
    """Measure meshes simplified within .02 voxel, and the share of triangles that is left."""
    rows = []
    for name in ("parts", "validation"):
        for whole in ("ours-marching", "ours"):
            methods, setting = (whole, f"{whole}/within"), Setting(bench.sizes[0])
            before, after = bench.measured(name, [({"set": name}, setting)], methods)
            rows.append({**after, "method": whole, "left": after["faces"] / before["faces"]})
    return rows


def speed(bench: Bench) -> list[Row]:
    """Measure whole processes, also beside dense upsampling, and a large grid."""
    model = ["--model", bench.network] if bench.network != DEFAULT_QUALITY else []
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for size in bench.sizes:
            found: dict[str, list[Row]] = {}
            for number, path in enumerate(spread(bench.shapes, TIMED)):
                grid = costs.write_grid(Shape.read(path), size, folder)
                plans: dict[str, Callable[[], Row]] = {}
                for option in OPTIONS:
                    words = [*option.split(), *(model if "quality" not in option else ())]
                    command = costs.upsample_words(grid, "--inside", "negative", *words)
                    plans[option or "default"] = partial(costs.timed, command, bench.runs)
                if number == 0 and size > bench.sizes[0]:
                    for option, order in DENSE.items():
                        dense = [str(grid), str(grid.with_suffix(".ply")), str(order)]
                        plans[option] = partial(costs.timed, ["-m", "lab.costs", *dense], 1)
                for option, measure in plans.items():
                    key = {"time": path.stem, "size": size, "runs": bench.runs, "option": option}
                    found.setdefault(option, []).append(bench.timed(key, measure))
            own = found["default"][0]
            for option, some in found.items():
                seconds = statistics.mean(row["seconds"] for row in some)
                peak = max(row["peak_mb"] for row in some)
                row = {"size": size, "option": option, "seconds": seconds, "peak_mb": peak}
                if option in DENSE:
                    row |= {f"over_{key}": row[key] / own[key] for key in ("seconds", "peak_mb")}
                rows.append(row)
        n, grid = LARGE * bench.sizes[-1] // 128, folder / "torus.npy"
        for limit in LIMITS:
            key = {"size": n, "option": f"torus-{limit}", "limit": limit}
            row = bench.timed(key, partial(large_row, grid, limit, n, model))
            rows.append({**key, **row})
    return rows


def large_row(grid: Path, limit: str, n: int, model: Sequence[str]) -> Row:
    if not grid.exists():
        costs.write_torus(grid, n)
    options = ["--json", "--spacing", str(1 / n), "--max-memory", limit, *model]
    try:
        seconds, peak, printed = costs.run_python(costs.upsample_words(grid, *options))
    except SuperSdfError as refusal:
        return {"refused": str(refusal).partition("Error: ")[2]}
    report = json.loads(printed)
    counts = {key: report[key] for key in ("tiles", "band_voxels", "triangles")}
    return {**counts, "seconds": seconds, "peak_mb": peak}


# How each is measured, and by which networks.
FIGURES: dict[str, tuple[Callable[[Bench], list[Row]], tuple[str, ...]]] = {
    "quality": (quality, ("fast", "base", "best", "noisy")),
    "halves": (halves, ("base",)),
    "edges": (edges, ("base",)),
    "kinds": (kinds, ("base", "mask", "noisy")),
    "noise": (noise, ("base", "noisy")),
    "scale": (scale, ("base",)),
    "factors": (factors, ("base",)),
    "simplify": (simplify, ("base",)),
    "speed": (speed, ("fast", "base", "best")),
    "masks": (masks, ("mask",)),
    "peers": (peers, ("base",)),
}
RARE = ("masks", "peers")  # need the extra peers, and take long for what few ask for


def write(name: str, rows: list[Row], bench: Bench, out: Path) -> Path:
    """Write a figure's file, with the commit of the sources and hashes of the networks' files."""
    git = ["git", "-C", str(FOLDER.parent), "rev-parse", "--short=9", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() or "unknown"
    digests = {}
    for network in FIGURES[name][1]:
        model = QUALITIES.get(network, (network, 1))[0]
        model = bench.network if network == DEFAULT_QUALITY else model
        digests[network] = digest_of_file(find_model(model, "auto")[0])[:12]
    content = {
        "name": name,
        "networks": digests,
        "commit": commit,
        "machine": costs.machine(),
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
    shapes, parts = (find_meshes(given) for given in (words.shapes, words.parts))
    some = (spread(paths, words.count or len(paths)) for paths in (shapes, parts))
    rows, sizes = Rows(words.out / ROWS), tuple(words.sizes)
    bench = Bench(*some, rows, words.network, sizes, words.jobs, words.runs)
    for name in words.only or [name for name in FIGURES if name not in RARE]:
        path = write(name, FIGURES[name][0](bench), bench, words.out)
        for table, text in tables_of(path).items():
            print(f"{table}\n\n{text}\n", flush=True)
