"""A row of figures: one shape, one setting, one method."""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..decoder import Decoder
from ..errors import OutOfMemoryError
from ..memory import forget_peak, held_memory
from ..mesh import Mesh
from ..network import find_model, load_network
from . import metrics
from .cases import RESULT_POINTS, Case, Setting, Shape
from .methods import EMPTY, METHODS, Surface
from .peers import PEERS

Row = dict[str, Any]

PROTOCOL = 2  # count up when a figure changes its meaning: the rows kept so far are then void
FLOOR = "floor"
NO_SETTING = Setting(0, 0)  # the floor's: the reference against itself
OURS = "ours"
PROCESS = "process"  # ours, as a whole process (see ``timing``)
# Modules by the start of their names that no surface depends on.
NOT_THE_METHOD = ("cli", "io", "errors")


@dataclass(frozen=True)
class Task:
    """What one process measures: some methods on one shape in one setting.

    ``limit`` is the seconds it may take, if there is a limit; ``mesh`` and ``digest`` are the
    sums of the mesh file and of what ours is made by: a row is known by them.
    """

    path: Path
    mesh: str
    setting: Setting
    methods: tuple[str, ...]
    model: str
    digest: str
    threads: int = 0
    limit: float | None = None

    def key(self, method: str) -> Row:
        """Return what a method's row is known by."""
        return {
            "shape": self.path.stem,
            "mesh": self.mesh,
            **asdict(self.setting),
            "method": method,
            "digest": self.digest if method in (OURS, PROCESS) else "",
            "protocol": PROTOCOL,
        }


def measure_task(task: Task, shape: Shape) -> Iterator[Row]:
    """Yield a row for each method of a task, which is of that shape."""
    # On the CPU, so that every machine agrees.
    network = load_network(task.model, device="cpu", threads=task.threads)
    try:
        case = None if task.setting == NO_SETTING else Case(shape, task.setting)
    except OutOfMemoryError as error:
        yield from (failed_row(task, shape, method, str(error)) for method in task.methods)
        return
    for method in task.methods:
        figures = measure_method(shape, case, method, network)
        yield {**task.key(method), **figures, "notes": list(shape.notes)}


def measure_method(shape: Shape, case: Case | None, method: str, network: Decoder) -> Row:
    """Return a method's figures; if it raises, those of a dot, with the reason in "error".

    ``seconds`` and ``peak_mb`` are those of making the mesh: from the grid in memory to the mesh
    in memory, and what was held at most beyond what was held before.
    """
    error = None
    held, clock = start_memory(), time.perf_counter()
    try:
        surface = make_surface(shape, case, method, network)
    except Exception as problem:  # named in the report; the other shapes still count
        traceback.print_exc()
        surface, error = Surface(EMPTY), f"{type(problem).__name__}: {problem}"
    seconds, peak = time.perf_counter() - clock, peak_since(held)
    figures = {**measure_surface(shape, surface.mesh), **measure_field(case, surface)}
    return {**figures, "seconds": seconds, "peak_mb": peak, "error": error}


def make_surface(shape: Shape, case: Case | None, method: str, network: Decoder) -> Surface:
    """Return what a method makes of a case; of the floor, the reference itself."""
    if case is None:
        return Surface(shape.mesh)
    return {**METHODS, **PEERS}[method](case, network)


def failed_row(task: Task, shape: Shape, method: str, error: str) -> Row:
    """Return the row of a method that made nothing: a dot's figures."""
    none = {"field_mse": None, "field_mae": None, "seconds": None, "peak_mb": None}
    figures = {**measure_surface(shape, EMPTY), **none}
    return {**task.key(method), **figures, "error": error, "notes": list(shape.notes)}


def measure_surface(shape: Shape, mesh: Mesh) -> Row:
    """Return every mesh figure of a result; without faces, a dot at the origin is measured."""
    drawn = metrics.sample_surface(mesh, shape.seed(RESULT_POINTS))
    edge_points = metrics.edge_points(drawn)
    return {
        **metrics.compare_samples(shape.drawn, drawn),
        **metrics.compare_surfaces(shape.solid, mesh, shape.drawn, drawn),
        **metrics.compare_edges(shape.mesh.vertices, shape.sharp, shape.sharp_drawn, edge_points),
        "closed": mesh.is_closed(),
        "outward": mesh.volume() > 0,
        "faces": len(mesh.faces),
    }


def measure_field(case: Case | None, surface: Surface) -> Row:
    """Return the squared and absolute error at the nodes of the band, each node once."""
    if case is None or surface.field is None:
        return {"field_mse": None, "field_mae": None}
    error = surface.field()[case.band].astype(np.float64) - case.truth[case.band]
    return {"field_mse": float(np.mean(error**2)), "field_mae": float(np.abs(error).mean())}


def start_memory() -> int | None:
    """Return the bytes held now, and count the peak from here."""
    forget_peak()
    return held_memory()


def peak_since(held: int | None) -> float | None:
    """Return by how many MB the peak is above what was held; None where it is not known."""
    peak = held_memory(peak=True)
    return None if held is None or peak is None else round(max(peak - held, 0) / 1e6, 1)


def digest_of_file(path: Path) -> str:
    """Return the sum of a file that tells it from others."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def digest_of_ours(model: str) -> str:
    """Return the sum of the network's file and of the code that runs it."""
    load_network(model, device="cpu")  # says what is wrong, before anything is measured
    code = sorted(Path(__file__).parent.parent.glob("*.py"))
    parts = [path for path in code if not path.stem.startswith(NOT_THE_METHOD)]
    network, symmetries = find_model(model)
    digest = hashlib.sha256(b"" if symmetries == 1 else str(symmetries).encode())
    for path in [network, *parts]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
