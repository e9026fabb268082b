"""Test ``super-sdf batch`` on many grids, some of them broken, with kills in between.

    python -m lab batch                                # 500 grids, 16^3 to 128^3
    python -m lab batch --count 20 --sizes 12 16 24    # half a minute
    python -m lab batch --count 200 --sizes 32 48 64 --cluster local

Writes the grids, runs the batch, kills it with SIGKILL ``--kills`` times, resumes it, runs it once
more, and holds the meshes against the truth and against ``super-sdf upsample``. On a cluster of
this machine a worker is killed in the middle instead, and the same batch is timed in processes.
"""

from __future__ import annotations

import argparse
import filecmp
import json
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import trimesh
from numpy.typing import NDArray

from super_sdf.machine.resources import count_cores
from super_sdf.mesh import Mesh

from . import forms, parser_of
from .processes import describe_machine
from .shapes import spread

Points = NDArray[np.float64]
COMMAND = [sys.executable, "-m", "super_sdf"]
FAR, MEAN = 1.0, 0.05  # voxels: largest accepted error of a vertex, and mean

# The grids: solids in closed form, so that meshes can be held against the truth at every vertex.

SOLIDS: dict[str, Callable[[Points, Points, Points], Points]] = {
    "ball": lambda x, y, z: forms.ball(x, y, z, 0, 1),
    "box": lambda x, y, z: forms.box(x, y, z, 0.8, 0.6, 0.4),
    "ring": lambda x, y, z: forms.torus(x, y, z, 0.7, 0.28),
    "rod": lambda x, y, z: forms.ball(x, y, z - np.clip(z, -0.6, 0.6), 0, 0.35),
    "slab": lambda x, y, z: forms.box(x, y, z, 0.7, 0.5, 0.1) - 0.15,  # rounded
}
SHEARED = [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]
# Broken files, and words that the error message must contain.
BROKEN = {
    "truncated.npy": "is truncated",
    "empty.npy": "is empty",
    "pickled.npy": "holds Python objects",
    "nan.npy": "touch samples on both sides of the surface",
    "flat.npy": "give three axes",
    "labels.npy": "choose one with --label",
    "constant.npy": "a constant field has no surface",
    "unsigned.npy": "unsigned distances have no inside",
    "sheared.npz": "are not at right angles",
    "corrupt.npz": "is damaged",
}


@dataclass(frozen=True)
class Placed:
    """A solid in a grid of side 1: its kind, position, rotation and size."""

    kind: str
    middle: Points
    turn: Points
    size: float

    @classmethod
    def random(cls, kind: str, rng: np.random.Generator) -> Placed:
        """Return a solid that stays away from the border of the grid."""
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        return cls(kind, rng.uniform(0.48, 0.52, 3), turn, rng.uniform(0.25, 0.34))

    def distance(self, points: Points) -> Points:
        """Return the signed distances (...) of points (..., 3) in the unit cube."""
        local = (points - self.middle) @ self.turn / self.size
        return np.asarray(SOLIDS[self.kind](*np.moveaxis(local, -1, 0)) * self.size)

    def samples(self, n: int) -> NDArray[np.float32]:
        """Return the samples at n^3 points with spacing 1/n."""
        return self.distance(np.moveaxis(np.indices((n,) * 3), 0, -1) / n).astype(np.float32)


def write_grids(folder: Path, count: int, sizes: list[int]) -> dict[str, Placed]:
    """Write grids of all sizes and solids; return the solid that each file holds."""
    rng, solids = np.random.default_rng(0), {}
    for i in range(count):
        n, kind = sizes[i % len(sizes)], list(SOLIDS)[i // len(sizes) % len(SOLIDS)]
        name = f"{n}/{kind}-{i:04}.np{'yz'[i % 2]}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        solids[name] = Placed.random(kind, rng)
        values = solids[name].samples(n)
        if name.endswith("y"):
            np.save(folder / name, values)
        else:
            np.savez(folder / name, values=values, spacing=1 / n, origin=0.0)
    return solids


def write_broken(folder: Path) -> None:
    """Write one file of each broken kind."""
    folder.mkdir(parents=True, exist_ok=True)
    values = Placed.random("ball", np.random.default_rng(0)).samples(24)
    np.save(folder / "truncated.npy", values)
    data = (folder / "truncated.npy").read_bytes()
    (folder / "truncated.npy").write_bytes(data[: len(data) // 2])
    (folder / "empty.npy").write_bytes(b"")
    np.save(folder / "pickled.npy", np.array([{}], object), allow_pickle=True)
    np.save(folder / "nan.npy", np.where(np.abs(values) < 0.02, np.nan, values))
    np.save(folder / "flat.npy", values[12])
    np.save(folder / "labels.npy", np.where(values < 0, 3, 0) + (values < -0.1))
    np.save(folder / "constant.npy", np.ones_like(values))
    np.save(folder / "unsigned.npy", np.abs(values))
    np.savez(folder / "sheared.npz", values=values, spacing=1 / 24, direction=SHEARED)
    with zipfile.ZipFile(folder / "corrupt.npz", "w") as archive:
        archive.writestr("values.npy", data)
    raw = bytearray((folder / "corrupt.npz").read_bytes())
    raw[len(raw) // 2] ^= 0xFF
    (folder / "corrupt.npz").write_bytes(raw)


@dataclass(frozen=True)
class Place:
    """A folder of grids, and the batch that converts them."""

    grids: Path
    meshes: Path
    options: Sequence[str]

    def rows(self) -> list[dict[str, Any]]:
        """Return the complete lines of the report."""
        report = self.meshes / "report.jsonl"
        lines = report.read_text().split("\n")[:-1] if report.exists() else []
        return [json.loads(line) for line in lines]

    def run(self, disturb_at: int | None = None, kill_worker: bool = False) -> str:
        """Run the batch to its end; return exit code, seconds and last line.

        It, or one of its workers, is killed when the report has ``disturb_at`` lines.
        """
        start, how = time.perf_counter(), ""
        words = [*COMMAND, "batch", str(self.grids), "--out", str(self.meshes), *self.options]
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        if disturb_at is not None:
            while len(self.rows()) < disturb_at and process.poll() is None:
                time.sleep(0.02)
            victims = workers_of(process.pid)[:1] if kill_worker else [process]
            for victim in victims:
                victim.kill()
            what = "a worker" if kill_worker else f"after {len(self.rows())} files"
            how = f"killed {what}; " if victims else "too late to kill a worker; "
        last = process.communicate()[1].strip().splitlines()[-1:]
        return f"{how}exit code {process.returncode}, {time.perf_counter() - start:.1f} s: {last}"


def workers_of(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a batch; none if it has ended."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []


def is_right(path: Path, solid: Placed, spacing: float, n: int) -> bool:
    """Return whether a mesh is closed and its vertices are on the surface of the solid.

    The spacing of an .npy is inferred: of a coarse grid approximately, as the report says.
    """
    read = trimesh.load(path, process=False)
    mesh = Mesh(np.asarray(read.vertices), np.asarray(read.faces, np.int32))
    away = np.abs(solid.distance(mesh.vertices / spacing / n)) * n
    return bool(mesh.is_closed() and away.max() < FAR and away.mean() < MEAN)


def count_right(place: Place, solids: Mapping[str, Placed]) -> int:
    """Count the meshes that exist and are correct."""
    rows, right = {row["out"]: row for row in place.rows()}, 0
    for name, solid in solids.items():
        target = Path(name).with_suffix(".ply")
        path, row = place.meshes / target, rows.get(target.as_posix(), {})
        if path.exists() and row.get("status") == "ok":
            right += is_right(path, solid, row["spacing"][0], row["shape"][0])
    return right


def count_equal(place: Place, names: Sequence[str]) -> int:
    """Count the meshes that are byte for byte those of ``super-sdf upsample``."""
    single, equal = place.meshes.parent / "single.ply", 0
    for name in names:
        words = ["upsample", str(place.grids / name), str(single), "--force", "--quiet"]
        subprocess.run([*COMMAND, *words], check=True)
        made = (place.meshes / name).with_suffix(".ply")
        equal += made.exists() and filecmp.cmp(single, made, shallow=False)
    return equal


def main() -> int:
    """Print the machine and a Markdown table; exit code 1 if anything is wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=500, help="grids, broken ones not counted")
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 24, 32, 48, 64, 96, 128])
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=count_cores(), help="processes")
    parser.add_argument("--equal", type=int, default=40, help="meshes held against single runs")
    parser.add_argument("--cluster", help="local, or the address of a scheduler")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jobs = ["--jobs", str(words.jobs)] if words.cluster in (None, "local") else []
        cluster = ["--cluster", words.cluster] if words.cluster else []
        place = Place(folder / "grids", folder / "meshes", [*jobs, *cluster])
        solids = write_grids(place.grids, words.count, words.sizes)
        print(f"{describe_machine()}; {words.count} grids\n\n| | |\n| --- | --- |", flush=True)
        return report(place, solids, words)


def report(place: Place, solids: Mapping[str, Placed], words: argparse.Namespace) -> int:
    """Run and kill, and print what came of it, row by row; return 1 if anything is wrong."""
    wrong = []

    def row(name: str, value: object, wanted: object = None) -> None:
        is_wrong = wanted is not None and value != wanted
        wrong.extend([name] if is_wrong else [])
        print(f"| {name} | {value}{f' of {wanted}' if wanted is not None else ''} |", flush=True)

    if words.cluster:
        row("one run", place.run(len(solids) // 2, kill_worker=True))
        others = Place(place.grids, place.meshes.parent / "others", ["--jobs", str(words.jobs)])
        row("in processes", others.run())
    else:
        write_broken(place.grids / "broken")
        total = len(solids) + len(BROKEN)
        for kill in range(1, words.kills + 1):
            row("run", place.run(total * kill // (words.kills + 1)))
        row("the last run", place.run())
        said = {Path(row["in"]).name: row["reason"] for row in place.rows() if row["reason"]}
        named = sum(text in said.get(name, "") for name, text in BROKEN.items())
        row("failures whose message names the fault", named, len(BROKEN))
    row("correct meshes", count_right(place, solids), len(solids))
    row("unfinished files left", len(list(place.meshes.rglob("*.part"))), 0)
    row("run again", place.run())
    names = spread(sorted(solids), words.equal)
    row("equal to single runs", count_equal(place, names), len(names))
    return int(bool(wrong))
