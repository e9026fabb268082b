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

from ..errors import FileError, SuperSdfError
from ..evaluation import metrics
from ..files.regular import check_regular_file
from ..machine.memory import forget_peak, held_memory
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..network.network import find_model, load_network
from .cases import RESULT_POINTS, Case, Setting, Shape
from .methods import METHODS, Surface
from .names import OURS, PROCESS
from .peers import PEERS

Measurement = dict[str, Any]

PROTOCOL = 2  # count up when a figure changes its meaning: the rows kept so far are then void
NO_SETTING = Setting(0, 0)  # the floor's: the reference against itself
BLOCK = 1 << 20  # bytes of a file that are held at a time
# The figures of a row, and those of them that may be None: what was not measured or is not known.
NUMBERS = (
    *("cd", "f1", "recall", "precision", "nc", "signed_nc"),
    *("p2s", "p2s_there", "p2s_back", "p99", "p99_there", "p99_back"),
    *("max", "max_there", "max_back", "closed", "outward", "faces", "seconds"),
)
OPTIONAL_NUMBERS = ("ecd", "ef1", "field_mse", "field_mae", "peak_mb")
# Rooms of the package that no surface depends on.
NOT_THE_METHOD = {"batch", "cli", "evaluation", "pictures"}


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

    def __str__(self) -> str:
        named = [str(self.setting), *(self.methods if self.limit else [])]
        return f"{self.path.stem} ({', '.join(named)})"

    def key(self, method: str) -> Measurement:
        """Return what a method's row is known by."""
        return {
            "shape": self.path.stem,
            "mesh": self.mesh,
            **asdict(self.setting),
            "method": method,
            "digest": self.digest if method in (OURS, PROCESS) else "",
            "protocol": PROTOCOL,
        }


def measure_task(task: Task, shape: Shape) -> Iterator[Measurement]:
    """Yield a row for each method of a task, which is of that shape."""
    try:
        # On the CPU, so that every machine agrees.
        network = load_network(task.model, device="cpu", threads=task.threads)
        case = None if task.setting == NO_SETTING else Case(shape, task.setting)
    except Exception as problem:  # every method of the task fails by it; the others still count
        yield from (failed_row(task, method, reason_of(problem)) for method in task.methods)
        return
    for method in task.methods:
        figures = measure_method(shape, case, method, network)
        yield {**task.key(method), **figures, "notes": list(shape.notes)}


def measure_method(shape: Shape, case: Case | None, method: str, network: Decoder) -> Measurement:
    """Return a method's figures; if it raises, none, with the reason in "error".

    A failure is no score: it says something of the machine or of a bug, not of the method.
    ``seconds`` and ``peak_mb`` are those of making the mesh: from the grid in memory to the mesh
    in memory, and what was held at most beyond what was held before.
    """
    held, clock = start_memory(), time.perf_counter()
    try:
        surface = make_surface(shape, case, method, network)
        seconds, peak = time.perf_counter() - clock, peak_since(held)
        figures = {**measure_surface(shape, surface.mesh), **measure_field(case, surface)}
    except Exception as problem:  # named in the report; the other shapes still count
        return {"error": reason_of(problem)}
    return {**figures, "seconds": seconds, "peak_mb": peak, "error": None}


def make_surface(shape: Shape, case: Case | None, method: str, network: Decoder) -> Surface:
    """Return what a method makes of a case; of the floor, the reference itself."""
    if case is None:
        return Surface(shape.mesh)
    return {**METHODS, **PEERS}[method](case, network)


def failed_row(task: Task, method: str, error: str) -> Measurement:
    """Return the row of a method that could not be measured: no figures, and why."""
    return {**task.key(method), "error": error}


def reason_of(problem: Exception) -> str:
    """Return what went wrong in a line; of a bug also where."""
    said = (str(problem).splitlines() or [""])[0]
    if isinstance(problem, SuperSdfError):
        return said
    if isinstance(problem, MemoryError):
        return "out of memory"
    last = traceback.extract_tb(problem.__traceback__)[-1:]
    place = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in last)
    return f"{type(problem).__name__}: {said}{place}"


def measure_surface(shape: Shape, mesh: Mesh) -> Measurement:
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


def measure_field(case: Case | None, surface: Surface) -> Measurement:
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
    """Return the sum of a file that tells it from others.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with check_regular_file(path).open("rb") as file:
            while block := file.read(BLOCK):
                digest.update(block)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    return digest.hexdigest()[:16]


def digest_of_ours(model: str) -> str:
    """Return the sum of the network's file and of the code that runs it."""
    load_network(model, device="cpu")  # says what is wrong, before anything is measured
    network, symmetries = find_model(model)
    digest = hashlib.sha256(b"" if symmetries == 1 else str(symmetries).encode())
    for path in [network, *code_of_method()]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def code_of_method() -> list[Path]:
    """Return the source files that a surface can depend on: all but those of rooms left out."""
    package = Path(__file__).parent.parent
    rooms = {path.name for path in package.iterdir()}
    assert rooms >= NOT_THE_METHOD, "a room that is left out is not there"
    files = package.rglob("*.py")
    return sorted(p for p in files if p.relative_to(package).parts[0] not in NOT_THE_METHOD)
