"""Measures one method on one shape in one setting."""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..certificate.surface import count_components
from ..errors import FileError, SuperSdfError
from ..files.regular import check_regular_file
from ..machine.memory import forget_peak, held_memory
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..network.names import AUTO_PRECISION, float32_name
from ..network.network import KIND_MODELS, find_model, load_network, shipped_models
from ..truth.solid import Distances, Solid
from . import edges, metrics
from .cases import RESULT_EDGES, RESULT_POINTS, Case, Setting, Shape
from .field_methods import FIELD_METHODS
from .methods import MESHED_METHODS, METHODS, SIMPLIFIED_METHODS, Method, Surface
from .names import is_of_our_code
from .peers import MATCHED_METHODS, PEERS

Measurement = dict[str, Any]
"""A line of ``results.jsonl``: the key (see ``Task.key``), then the figures, or the "error"."""

PROTOCOL = 2  # increase it when a figure changes its meaning: older measurements do not count then
NO_SETTING = Setting(0, 0)  # of the floor: nothing is sampled
BLOCK = 1 << 20  # bytes of a file that are read at a time
# The figures of a measurement; the optional ones are None, or absent, where they are unknown.
NUMBERS = (
    *("cd", "f1", "recall", "precision", "nc", "signed_nc"),
    *("p2s", "p2s_there", "p2s_back", "p99", "p99_there", "p99_back"),
    *("max", "max_there", "max_back", "closed", "outward", "faces", "seconds"),
)
VOXEL_NUMBERS = ("efv", "edge_distance", "angle_near", "angle_beyond")
OPTIONAL_NUMBERS = (
    *("ecd", "ef1", "field_mse", "field_mae", "peak_mb"),
    *VOXEL_NUMBERS,
    *("min_angle", "slivers"),
    *("volume_off", "pieces", "pieces_of_reference", "told"),
)
TEXTS = ("taken_as", "refused")  # of super-sdf on a kind of grid: what it took the values for
# Folders of the package whose code does not change any surface.
NOT_THE_METHOD = {"batch", "certificate", "cli", "evaluation", "pictures"}


@dataclass(frozen=True)
class Task:
    """What one process measures: some methods on one shape in one setting.

    Attributes
    ----------
    path : Path
        The mesh file of the shape.
    mesh, digest : str
        Hashes of the mesh file, and of our network and code.
    setting : Setting
    methods : tuple of str
        Names of methods or peers, in the order of measuring.
    model, precision : str
        The network: see ``load_network``.
    threads : int
        Threads of the network; 0: one per core.
    limit : float, optional
        Seconds that the task may take.
    turned : int, optional
        Seed by which the shape is turned at random; as its file has it unless given.
    peer_meshes : Path, optional
        Folder in which the meshes of peers are kept.
    """

    path: Path
    mesh: str
    setting: Setting
    methods: tuple[str, ...]
    model: str
    digest: str
    precision: str = AUTO_PRECISION
    threads: int = 0
    limit: float | None = None
    turned: int | None = None
    peer_meshes: Path | None = None

    def __str__(self) -> str:
        named = [str(self.setting), *(self.methods if self.limit else [])]
        return f"{self.path.stem} ({', '.join(named)})"

    def key(self, method: str) -> Measurement:
        """Return the key of a method's measurement: it is valid as long as nothing here changes."""
        return {
            "shape": self.path.stem,
            "mesh": self.mesh,
            "turned": self.turned,
            **asdict(self.setting),
            "method": method,
            "digest": self.digest if is_of_our_code(method) else "",
            "protocol": PROTOCOL,
        }


def measure_task(task: Task, shape: Shape) -> Iterator[Measurement]:
    """Yield a measurement for each method of a task; ``shape`` is that of the task."""
    try:
        # On the CPU, for the same results on every machine.
        network = load_network(
            task.model, device="cpu", threads=task.threads, precision=task.precision
        )
        case = None if task.setting == NO_SETTING else Case(shape, task.setting, task.peer_meshes)
    except Exception as problem:  # all methods of the task fail; other tasks still count
        yield from (failed_row(task, method, reason_of(problem)) for method in task.methods)
        return
    for method in task.methods:
        figures = measure_method(shape, case, method, network)
        yield {**task.key(method), **figures, "notes": list(shape.notes)}


def measure_method(shape: Shape, case: Case | None, method: str, network: Decoder) -> Measurement:
    """Return a method's figures, or the reason in "error" if it raised an exception.

    A failure is not a score: its cause is the machine or a bug, not the method. ``seconds`` is the
    time from the grid in memory to the mesh in memory, ``peak_mb`` the peak of memory meanwhile,
    less what the process held before.
    """
    held, clock = start_memory(), time.perf_counter()
    try:
        surface = make_surface(shape, case, method, network)
        seconds, peak = time.perf_counter() - clock, peak_since(held)
        spacing = None if case is None else case.spacing
        if method in FIELD_METHODS:
            figures = measure_on_kind(shape, surface.mesh)
        else:
            figures = measure_surface(shape, surface.mesh, spacing)
        figures |= measure_field(case, surface)
    except Exception as problem:  # named in the report; the other shapes still count
        return {"error": reason_of(problem)}
    if surface.seconds is not None:
        seconds = surface.seconds
    return {**figures, **(surface.facts or {}), "seconds": seconds, "peak_mb": peak, "error": None}


def make_surface(shape: Shape, case: Case | None, method: str, network: Decoder) -> Surface:
    """Return the surface that a method makes of a case; without a case, the reference itself."""
    if case is None:
        return Surface(shape.mesh)
    ours = {**MESHED_METHODS, **SIMPLIFIED_METHODS, **MATCHED_METHODS, **FIELD_METHODS}
    by_name: dict[str, Method] = {**ours, **METHODS, **PEERS}
    return by_name[method](case, network)


def failed_row(task: Task, method: str, error: str) -> Measurement:
    """Return the measurement of a method that failed: the reason, and no figures."""
    return {**task.key(method), "error": error}


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


@dataclass(frozen=True, eq=False)
class Compared:
    """A result, the points drawn from it, and how far both surfaces are from each other's points.

    ``there`` are the distances of the reference's points to the result, ``back`` those of the
    result's points to the reference, and ``nearest`` its triangles nearest to them.
    """

    result: Solid
    drawn: metrics.SurfacePoints
    there: Distances
    back: Distances
    nearest: metrics.Indices

    @classmethod
    def of(cls, shape: Shape, mesh: Mesh) -> Compared:
        """Compare a result with a shape; a mesh without faces counts as a dot at the origin."""
        result = Solid(mesh)
        drawn = metrics.sample_surface(mesh, shape.seed(RESULT_POINTS)).ordered()
        there = metrics.distance_or_dot(result, shape.drawn.points)
        return cls(result, drawn, there, *metrics.nearest_or_dot(shape.solid, drawn.points))

    def figures(self, shape: Shape) -> Measurement:
        """Return the figures of every result."""
        mesh = self.result.mesh
        return {
            **metrics.compare_samples(shape.drawn, self.drawn),
            **metrics.compare_distances(self.there, self.back),
            "closed": mesh.is_closed(),
            "outward": mesh.volume() > 0,
            "faces": len(mesh.faces),
        }


def measure_surface(shape: Shape, mesh: Mesh, spacing: float | None) -> Measurement:
    """Return the figures of a result's mesh; a mesh without faces counts as a dot at the origin.

    ``spacing`` is that of the coarse grid; without one, figures in voxels are None.
    """
    found = Compared.of(shape, mesh)
    return {
        **found.figures(shape),
        **edges.compare_edges(shape.sharp, edges.edge_points(found.drawn)),
        **measure_edges(shape, found.result, found.drawn, found.nearest, spacing),
        **metrics.compare_triangles(mesh),
    }


def measure_on_kind(shape: Shape, mesh: Mesh) -> Measurement:
    """Return the figures of a result on a kind of grid, which has no table of edges.

    Without edges and angles it takes half the time.
    """
    return {
        **Compared.of(shape, mesh).figures(shape),
        "volume_off": mesh.volume() / shape.mesh.volume() - 1,
        "pieces": count_components(mesh.faces, len(mesh.vertices)),
        "pieces_of_reference": count_components(shape.mesh.faces, len(shape.mesh.vertices)),
    }


def measure_edges(
    shape: Shape,
    result: Solid,
    drawn: metrics.SurfacePoints,
    nearest: metrics.Indices,
    spacing: float | None,
) -> Measurement:
    """Return the figures of edges and normals that have the coarse voxel as their unit.

    ``nearest`` are the reference's triangles that are nearest to the points drawn.
    """
    if spacing is None:
        return dict.fromkeys(VOXEL_NUMBERS)
    return {
        **edges.compare_in_voxels(shape.sharp, result, shape.seed(RESULT_EDGES), spacing),
        **edges.compare_angles(shape.mesh, nearest, shape.sharp, drawn, spacing),
    }


def measure_field(case: Case | None, surface: Surface) -> Measurement:
    """Return the mean squared and absolute errors at the nodes of the band, each counted once."""
    if case is None or surface.field is None:
        return {"field_mse": None, "field_mae": None}
    error = surface.field()[case.band].astype(np.float64) - case.truth[case.band]
    return {"field_mse": float(np.mean(error**2)), "field_mae": float(np.abs(error).mean())}


def start_memory() -> int | None:
    """Return the bytes held now; the peak of memory counts from here."""
    forget_peak()
    return held_memory()


def peak_since(held: int | None) -> float | None:
    """Return the peak of memory less what was held at the start, in MB; None if unknown."""
    peak = held_memory(peak=True)
    return None if held is None or peak is None else round(max(peak - held, 0) / 1e6, 1)


def digest_of_file(path: Path) -> str:
    """Return a hash of a file's content.

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


def digest_of_ours(model: str, precision: str = AUTO_PRECISION) -> str:
    """Return a hash of the network's file, of those that replace it, and of the code."""
    load_network(model, device="cpu", precision=precision)  # raises before anything is measured
    network, symmetries = find_model(model, precision)
    digest = hashlib.sha256(b"" if symmetries == 1 else str(symmetries).encode())
    shipped = shipped_models().items()
    for_kinds = [path for name, path in shipped if float32_name(name) in KIND_MODELS]
    for path in [network, *for_kinds, *code_of_method()]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def code_of_method() -> list[Path]:
    """Return the source files that a surface may depend on."""
    package = Path(__file__).parent.parent
    folders = {path.name for path in package.iterdir()}
    assert folders >= NOT_THE_METHOD, "a folder in NOT_THE_METHOD does not exist"
    files = package.rglob("*.py")
    return sorted(p for p in files if p.relative_to(package).parts[0] not in NOT_THE_METHOD)
