"""Kill conversions and batches at random moments, and check what is left.

    python -m lab faults                                        # half an hour
    python -m lab faults --runs 2 --size 12 --count 4           # a minute
    python -m lab faults --count 2000 --bad .1 --runs 30 --only batch

``super-sdf upsample`` in every format, and ``super-sdf batch``, are ended by a signal, or lose a
worker, or may write files of a random size only. Whatever has its final name must be complete.
After the kills the command is run once more: then all is there, nothing is made twice, and the
record of a batch has one valid row for each file.
"""

from __future__ import annotations

import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
import psutil

from super_sdf.files.meshes import MESH_SUFFIXES

from . import parser_of

COMMAND = [sys.executable, "-m", "super_sdf"]
SIGNALS = ("SIGTERM", "SIGHUP", "SIGKILL")
LIMIT, WORKER = "file limit", "worker SIGKILL"
RECORD = "report.jsonl"


def run(words: list[str], fault: str, longest: float, largest: int) -> str:
    """Run a command with a fault at a random moment; return what is wrong with how it ends."""
    limit = random.randrange(largest) if fault == LIMIT else None
    lower = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit)) if limit else None
    process = subprocess.Popen(words, stderr=subprocess.PIPE, preexec_fn=lower)
    number = getattr(signal, fault, signal.SIGKILL)
    if fault not in ("", LIMIT):
        time.sleep(random.uniform(0, longest))
        with suppress(psutil.Error, IndexError):  # it was through
            parent = psutil.Process(process.pid)
            victim = random.choice(parent.children()) if fault == WORKER else parent
            victim.send_signal(number)
    said = process.communicate(timeout=600)[1].decode()
    if fault != "SIGKILL" and "Traceback" in said:
        return f"prints {said}"
    bad = said.startswith("Failed: ")  # of files that are no grids, which a batch names
    fine = (0, bad) if not fault else (0, 1, 128 + number, -number)
    return "" if process.returncode in fine else f"exit code {process.returncode}: {said[:200]}"


def wrong_files(out: Path, right: dict[str, bytes], is_last: bool, is_batch: bool) -> str:
    """Return what is half-written; after the last run also what is missing, or recorded twice."""
    found = {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()}
    if half := [n for n in right.keys() & found if found[n].read_bytes() != right[n]]:
        return f"half-written: {half}"
    if is_last and (more := right.keys() ^ {n for n in found if n != RECORD and n[0] != "."}):
        return f"missing or left over: {sorted(more)}"
    if not (is_last and is_batch):
        return ""
    rows = [json.loads(line) for line in found[RECORD].read_bytes().splitlines()]
    twice = [n for n, k in Counter(r["out"] for r in rows if r["status"] == "ok").items() if k > 1]
    return f"made twice: {twice}" if twice else ""


def trial(words: list[str], out: Path, fault: str, runs: int) -> Counter[str]:
    """Disturb a command again and again; return how often what was wrong, "right" for nothing.

    A batch goes on from one kill to the next, a conversion begins anew.
    """
    is_batch, found = words[3] == "batch", Counter[str]()
    rmtree(out, ignore_errors=True)
    out.mkdir()
    start = time.perf_counter()
    found[run(words, "", 0, 1) or "right"] += 1
    seconds = time.perf_counter() - start
    meshes = (path for path in out.rglob("*") if path.suffix in MESH_SUFFIXES)
    right = {path.relative_to(out).as_posix(): path.read_bytes() for path in meshes}
    largest = max(map(len, right.values()), default=1)
    for turn in range(runs):
        if turn == 0 or not is_batch:
            rmtree(out)
            out.mkdir()
        longest = seconds / runs * 2 if is_batch else seconds
        wrong = run(words, fault, longest, largest)
        wrong = wrong or wrong_files(out, right, False, is_batch)
        found[wrong or "right"] += 1
    found[run(words, "", 0, 1) or wrong_files(out, right, True, is_batch) or "right"] += 1
    return found


def write_balls(folder: Path, count: int, size: int, bad: float) -> None:
    """Write grids of balls, no two alike, and a share of files that are no grids."""
    x, y, z = np.indices((size,) * 3) - size / 2 + 0.4
    folder.mkdir()
    for number in range(count):
        path = folder / f"{number:05}.npz"
        if random.random() < bad:
            path.write_bytes(b"no grid")
            continue
        values = np.sqrt((x - 2 * number / count) ** 2 + y**2 + z**2) - size / 3 + number / count
        values = values.astype(np.float32)
        np.savez(path, values=values, spacing=1.0, origin=0.0)


def main() -> int:
    """Run all trials, print a line for each fault; exit code 1 if anything was wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=50, help="of each fault")
    parser.add_argument("--only", choices=("upsample", "batch"))
    parser.add_argument("--size", type=int, default=24, help="samples along each axis")
    parser.add_argument("--count", type=int, default=8, help="grids of the batch")
    parser.add_argument("--bad", type=float, default=0.0, help="share of them that are no grids")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    words = parser.parse_args()
    random.seed(words.seed)
    failed = False
    with tempfile.TemporaryDirectory() as name:
        grids, out = Path(name) / "grids", Path(name) / "out"
        write_balls(grids, words.count, words.size, words.bad)
        quick = ["--quality", "fast", "--factor", "2", "--quiet"]
        good = next(p for p in sorted(grids.iterdir()) if p.stat().st_size > 100)
        jobs = {
            **{f"upsample{s}": ["upsample", str(good), str(out / f"mesh{s}"), "--force"]
               for s in MESH_SUFFIXES},
            "batch": ["batch", str(grids), "--out", str(out), "--jobs", "2"],
        }  # fmt: skip
        for job, first in jobs.items():
            for fault in (*SIGNALS, LIMIT, *([WORKER] if job == "batch" else [])):
                if words.only in (None, first[0]):
                    found = trial([*COMMAND, *first, *quick], out, fault, words.runs)
                    failed |= set(found) != {"right"}
                    said = "; ".join(f"{what}: {count}" for what, count in found.items())
                    print(f"{job}, {fault}: {said}", flush=True)
    return int(failed)
