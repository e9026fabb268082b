"""What is wrong with how a command ended, and with the meshes that it made."""

from __future__ import annotations

import builtins
import json
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from super_sdf.files.meshes import MESH_SUFFIXES

from .case import Case
from .running import Run


def faults_of_mesh(path: Path, *, may_be_open: bool) -> list[str]:
    """Return what is wrong with a mesh: vertices not finite or not distinct, edges open."""
    import trimesh

    try:
        found = trimesh.load(path, process=False)
        parts = list(getattr(found, "geometry", {"": found}).values())
        vertices, faces = np.asarray(parts[0].vertices), np.asarray(parts[0].faces, np.int64)
    except Exception as error:  # whatever a reader makes of the file, others would meet it too
        return [f"cannot be read back: {type(error).__name__}: {error}"]
    if len(parts) != 1 or not len(faces):
        return ["holds no triangle" if len(parts) == 1 else f"holds {len(parts)} meshes"]
    if not np.isfinite(vertices).all():
        return [f"{int((~np.isfinite(vertices)).any(1).sum())} vertices are not finite"]
    return list(_faults(vertices, faces, path.suffix == ".stl", may_be_open))


def _faults(vertices: np.ndarray, faces: np.ndarray, is_soup: bool, may_be_open: bool):
    used, at = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    if len(used) < len(vertices) and not is_soup:
        yield "vertices at the same position"
    faces = at.ravel()[faces]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    if (start == end).any():
        yield "triangles that have collapsed"
    forward, times = np.unique(start * len(used) + end, return_counts=True)
    if (times > 1).any():
        yield "edges that two triangles run along in one direction"
    if not may_be_open and len(np.setxor1d(forward, end * len(used) + start)):
        yield "open edges that nothing was said of"


def count(path: Path) -> tuple[int, int]:
    """Return how many distinct vertices and how many triangles a mesh file holds."""
    import trimesh

    found = trimesh.load(path, process=False)
    part = next(iter(getattr(found, "geometry", {"": found}).values()))
    return len(np.unique(np.asarray(part.vertices) + 0.0, axis=0)), len(part.faces)


TOO_MUCH = 1 << 30  # bytes more than before, for inputs of some kilobytes
LEFT = re.compile(r"\.part$|^tmp|\.tmp$|^\.~")
NAMED_BUG = re.compile(r"\b([A-Z]\w+): ")
COUNTS = re.compile(r": ([\d,]+) vertices, ([\d,]+) triangles")
# How each line begins on standard error: after success, and where files failed one by one.
SAID = re.compile(r"Note: |Warning: |Simplified: |.*: [\d,]+ (vertices|x )|\d+ of \d+: ")
FAILED = re.compile(
    r"Failed: |Left out: |Error: |Note: |Warning: |\d+ |and \d+ more|nothing to do|.*\.md$"
)
Snapshot = dict[str, str]


class Fault(NamedTuple):
    """Something that must not be: its kind, and what exactly."""

    kind: str
    what: str


def snapshot(folder: Path) -> Snapshot:
    """Return what lies in a folder, each path with what it is."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in folders + files:
            path = Path(root, name)
            found[path.relative_to(folder).as_posix()] = _identify(path)
    return found


def _identify(path: Path) -> str:
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    if path.is_file():
        if path.stat().st_size > 50_000_000:
            return f"file of {path.stat().st_size} bytes"
        return blake2b(path.read_bytes(), digest_size=16).hexdigest()
    return "folder" if path.is_dir() else "special"


def judge(case: Case, run: Run, folder: Path, before: Snapshot) -> list[Fault]:
    """Return all that is wrong."""
    if run.trace:
        is_hang = "HangError" in run.trace or run.trace.startswith("hangs")
        kind = "hang" if is_hang else "crash" if run.trace.startswith("crash") else "traceback"
        faults = [Fault(kind, run.trace)]
    else:
        faults = [*_of_words(case, run), *_of_json(case, run)]
    faults += [Fault("warning", text) for text in run.warned]
    faults += _of_files(case, run, before, snapshot(folder), folder)
    if run.grown > TOO_MUCH:
        faults.append(Fault("memory", f"{run.grown / 1e9:.1f} GB for a small input"))
    return faults


def _of_words(case: Case, run: Run) -> list[Fault]:
    if run.code not in (0, 1, 2):
        return [Fault("code", f"exit code {run.code}")]
    lines = run.err.rstrip("\n").split("\n") if run.err.strip() else []
    faults = [Fault("bug named", line[:300]) for line in lines if _names_a_bug(line)]
    single = case.command in ("upsample", "sample") or run.code == 2
    if run.code and single and (len(lines) != 1 or not lines[0].startswith("Error: ")):
        faults.append(Fault("not one line", f"{len(lines)} lines: {run.err[:300]!r}"))
    if run.code and not single:
        faults += [Fault("stray line", line[:300]) for line in lines if not FAILED.match(line)]
        if not lines and "--check" not in case.words:
            faults.append(Fault("silent", f"exit code {run.code} without a word"))
    says_more = "-v" in case.words or any("\n" in word for word in case.words)
    if not run.code and single and not says_more:
        faults += [Fault("stray line", line[:300]) for line in lines if not SAID.match(line)]
    return faults


def _names_a_bug(line: str) -> bool:
    names = NAMED_BUG.findall(line.removeprefix("Error: "))
    kinds = (getattr(builtins, name, None) for name in names if name != "Warning")
    shown = any(isinstance(kind, type) and issubclass(kind, BaseException) for kind in kinds)
    return shown or line.startswith("Traceback")


def _of_json(case: Case, run: Run) -> list[Fault]:
    if "--json" not in case.words or run.code == 2 or not run.out:
        return []

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON")

    try:
        json.loads(run.out, parse_constant=refuse)
    except ValueError as error:
        return [Fault("no JSON", str(error))]
    return []


def _of_files(case: Case, run: Run, before: Snapshot, after: Snapshot, folder: Path) -> list[Fault]:
    new = [name for name in after if before.get(name) != after[name]]
    faults = [Fault("left over", n) for n in new if LEFT.search(Path(n).name)]
    new = [name for name in new if not LEFT.search(Path(name).name)]
    allowed = [name for name in new if any(fnmatch(name, made) for made in case.makes)]
    faults += [Fault("made unasked", name) for name in new if name not in allowed]
    faults += [Fault("gone", name) for name in before if name not in after]
    single = case.command in ("upsample", "sample")
    if single and run.code and allowed:
        faults.append(Fault("made in spite of failure", ", ".join(allowed)))
    if single and not run.code and not allowed and "-h" not in case.words:
        faults.append(Fault("nothing made", "exit code 0"))
    if single and "--force" not in case.words:
        faults += [Fault("overwritten", name) for name in allowed if name in before]
    meshes = [name for name in allowed if Path(name).suffix in MESH_SUFFIXES]
    return faults + [fault for name in meshes for fault in _of_mesh(case, run, folder / name)]


def _of_mesh(case: Case, run: Run, path: Path) -> list[Fault]:
    if not path.is_file():
        return []
    told_open = "runs out of the grid" in run.err + run.out or '"closed": false' in run.out
    for ledger in [folder / "report.jsonl" for folder in path.parents]:
        told_open |= ledger.is_file() and '"closed": false' in ledger.read_text(errors="replace")
    faults = faults_of_mesh(path, may_be_open=told_open)
    said = COUNTS.search(run.err)
    if said and not faults:
        told = tuple(int(number.replace(",", "")) for number in said.groups())
        if told != count(path):
            faults.append(f"holds other counts than {path.suffix} can")
    return [Fault("mesh", f"{path.suffix}: {fault}") for fault in faults]


class Outcome(NamedTuple):
    """How a case ended, and what is wrong with that."""

    case: Case
    run: Run
    faults: list[Fault]


def try_case(case: Case, run_words: Callable[[Sequence[str], Path], Run]) -> Outcome:
    """Build a case in an empty folder, run it and judge it."""
    with tempfile.TemporaryDirectory(prefix="corpus-") as name:
        folder = Path(os.path.realpath(name))
        case.build(folder)
        before = snapshot(folder)
        run = run_words(case.words, folder)
        return Outcome(case, run, judge(case, run, folder, before))
