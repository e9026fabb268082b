"""Measures methods on a shape in a setting: what one process does."""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import super_sdf
from super_sdf.errors import SuperSdfError
from super_sdf.network.contract import Decoder
from super_sdf.network.network import KIND_MODELS, find_model, load_network, shipped_models
from super_sdf.options import DEFAULT_QUALITY

from .kinds import MASKS
from .methods import FLOOR, ON, make_surface
from .metrics import METRICS, OF_KINDS, Comparison, Measure
from .shapes import Case, Setting, Shape
from .surfaces import Surface

Measurement = dict[str, Any]
"""The figures of a method, or the "error"."""

PROTOCOL = 3  # increase it when a figure changes its meaning: older measurements do not count then
NO_SETTING = Setting(0, 0)  # of the floor: nothing is sampled
# Methods whose results do not depend on the code and the networks of this package.
OF_OTHERS = (
    *(*MASKS[:-1], "mc-lewiner", "trilinear", "bspline", "bound"),
    *(FLOOR, "dual-contouring", "ndc"),
)
# Folders and modules of the package whose code does not change any surface.
NOT_THE_METHOD = {"batch", "check.py", "cli", "evaluation.py", "labels", "pages"}


@dataclass(frozen=True)
class Task:
    """What one process measures: some methods on one shape in one setting."""

    path: Path
    setting: Setting
    methods: tuple[str, ...]  # in the order of measuring
    model: str = DEFAULT_QUALITY
    precision: str = "auto"
    threads: int = 0  # of the network; 0: one per core
    turned: int | None = None  # seed by which the shape is turned at random
    triangles: tuple[tuple[str, int], ...] = ()  # of methods that were measured before

    def network(self, method: str) -> tuple[str, str]:
        model, _, precision = method.partition("@")[2].partition(":")
        return (model, precision or "auto") if model else (self.model, self.precision)

    def key(self, method: str) -> Measurement:
        """Return the key of a method's measurement: it is valid as long as nothing here changes."""
        is_others = method.partition("@")[0].partition(ON)[0] in OF_OTHERS
        return {
            "shape": self.path.stem,
            "mesh": digest_of_file(self.path),
            "turned": self.turned,
            **asdict(self.setting),
            "method": method,
            "digest": "" if is_others else digest_of_ours(*self.network(method)),
            "protocol": PROTOCOL,
        }


def measure_task(task: Task, shape: Shape) -> Iterator[tuple[str, Measurement]]:
    """Yield each method of a task and its figures; ``shape`` is that of the task."""
    try:
        case = None if task.setting == NO_SETTING else Case(shape, task.setting)
    except Exception as problem:  # all methods of the task fail; other tasks still count
        yield from ((method, {"error": reason_of(problem)}) for method in task.methods)
        return
    if case:
        case.triangles.update(task.triangles)
    for method in task.methods:
        figures = measure_method(shape, case, method, task)
        if case and "faces" in figures:
            case.triangles[method] = figures["faces"]
        yield method, figures


@lru_cache(maxsize=4)
def network_of(model: str, precision: str, threads: int) -> Decoder:
    """Load a network once; on the CPU, for the same results on every machine."""
    return load_network(model, device="cpu", threads=threads, precision=precision)


def measure_method(shape: Shape, case: Case | None, method: str, task: Task) -> Measurement:
    """Return a method's figures, or the reason in "error" if it raised an exception.

    A failure is not a score: its cause is the machine or a bug, not the method.
    """
    try:
        network = network_of(*task.network(method), task.threads)
        clock = time.perf_counter()
        surface = make_surface(method, case, network) if case else Surface(shape.mesh)
        seconds = time.perf_counter() - clock
        off = np.zeros(0)
        if case and surface.field:
            off = surface.field()[case.band].astype(np.float64) - case.truth[case.band]
        spacing = case.spacing if case else None
        compared = Comparison(shape, surface.mesh, spacing, off, seconds)
        figures = {key: of(compared) for key, of in measures(method).items()}
    except Exception as problem:  # named in the report; the other shapes still count
        return {"error": reason_of(problem)}
    return {**figures, **(surface.facts or {}), "error": None}


def measures(method: str) -> dict[str, Measure]:
    """Return the functions of the metrics that are measured of a method's results."""
    return OF_KINDS if ON in method else {m.key: m.of for m in METRICS.values() if m.of}


def reason_of(problem: Exception) -> str:
    """Return what went wrong in one line; for a bug also where."""
    message = (str(problem).splitlines() or [""])[0]
    if isinstance(problem, SuperSdfError):
        return message
    if isinstance(problem, MemoryError):
        return "out of memory"
    last = traceback.extract_tb(problem.__traceback__)[-1:]
    place = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in last)
    return f"{type(problem).__name__}: {message}{place}"


@cache
def digest_of_file(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@cache
def digest_of_ours(model: str, precision: str = "auto") -> str:
    """Return a hash of a network's file, of those that replace it for a kind, and of the code."""
    network, symmetries = find_model(model, precision)
    digest = hashlib.sha256(str(symmetries).encode())
    shipped = shipped_models().items()
    for_kinds = [path for name, path in shipped if name.removesuffix("-int8") in KIND_MODELS]
    package = Path(super_sdf.__file__).parent
    files = sorted(package.rglob("*.py"))
    code = [p for p in files if p.relative_to(package).parts[0] not in NOT_THE_METHOD]
    for path in [network, *for_kinds, *code]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
