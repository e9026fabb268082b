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
from super_sdf.network.decoder import Decoder
from super_sdf.network.network import (
    KIND_MODELS,
    find_model,
    float32_name,
    load_network,
    shipped_models,
)
from super_sdf.options import AUTO, DEFAULT_QUALITY
from super_sdf.surface.mesh import Mesh
from super_sdf.truth.solid import Solid

from . import edges, metrics
from .methods import FLOOR, ON, make_surface
from .shapes import RESULT_EDGES, RESULT_POINTS, Case, Setting, Shape
from .surfaces import Surface

Measurement = dict[str, Any]
"""The figures of a method, or the "error"."""

PROTOCOL = 3  # increase it when a figure changes its meaning: older measurements do not count then
NO_SETTING = Setting(0, 0)  # of the floor: nothing is sampled
VOXEL_NUMBERS = ("efv", "edge_distance", "angle_near", "angle_beyond")
# Methods whose results do not depend on the code and the networks of this package.
OF_OTHERS = (
    *("mc", "mc-lewiner", "mc-distances", "trilinear", "bspline", "bound"),
    *(FLOOR, "dual-contouring", "ndc"),
)
# Folders of the package whose code does not change any surface.
NOT_THE_METHOD = {"batch", "certificate", "cli", "cluster", "pages"}


@dataclass(frozen=True)
class Task:
    """What one process measures: some methods on one shape in one setting."""

    path: Path
    setting: Setting
    methods: tuple[str, ...]  # in the order of measuring
    model: str = DEFAULT_QUALITY
    precision: str = AUTO
    threads: int = 0  # of the network; 0: one per core
    turned: int | None = None  # seed by which the shape is turned at random
    limit: float | None = None  # seconds
    triangles: tuple[tuple[str, int], ...] = ()  # of methods that were measured before

    def network(self, method: str) -> tuple[str, str]:
        """Return model and precision of a method."""
        model, _, precision = method.partition("@")[2].partition(":")
        return (model, precision or AUTO) if model else (self.model, self.precision)

    def key(self, method: str) -> Measurement:
        """Return the key of a method's measurement: it is valid as long as nothing here changes."""
        return {
            "shape": self.path.stem,
            "mesh": digest_of_file(self.path),
            "turned": self.turned,
            **asdict(self.setting),
            "method": method,
            "digest": digest_of_ours(*self.network(method)) if is_of_our_code(method) else "",
            "protocol": PROTOCOL,
        }


def is_of_our_code(method: str) -> bool:
    """Return whether a measurement depends on the code and the networks of this package."""
    name = method.partition("@")[0].partition(ON)[0]
    return name not in OF_OTHERS and not name.startswith("mc-gaussian")


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
        yield method, {**figures, "notes": list(shape.notes)}


@lru_cache(maxsize=4)
def network_of(model: str, precision: str, threads: int) -> Decoder:
    """Load a network once; on the CPU, for the same results on every machine."""
    return load_network(model, device="cpu", threads=threads, precision=precision)


def measure_method(shape: Shape, case: Case | None, method: str, task: Task) -> Measurement:
    """Return a method's figures, or the reason in "error" if it raised an exception.

    A failure is not a score: its cause is the machine or a bug, not the method. ``seconds`` is the
    time from the grid in memory to the mesh in memory.
    """
    try:
        network = network_of(*task.network(method), task.threads)
        clock = time.perf_counter()
        surface = make_surface(method, case, network) if case else Surface(shape.mesh)
        seconds = time.perf_counter() - clock
        if ON in method:
            figures = measure_on_kind(shape, surface.mesh)
        else:
            figures = measure_surface(shape, surface.mesh, case.spacing if case else None)
        figures |= measure_field(case, surface)
    except Exception as problem:  # named in the report; the other shapes still count
        return {"error": reason_of(problem)}
    return {**figures, **(surface.facts or {}), "seconds": seconds, "error": None}


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


def measure_surface(shape: Shape, mesh: Mesh, spacing: float | None) -> Measurement:
    """Return the figures of a result's mesh; a mesh without faces counts as a dot at the origin.

    ``spacing`` is that of the coarse grid; without one, figures in voxels are None.
    """
    figures, result, drawn, nearest = compare(shape, mesh)
    in_voxels: Measurement = dict.fromkeys(VOXEL_NUMBERS)
    if spacing is not None:
        seed = shape.seed(RESULT_EDGES)
        in_voxels = edges.compare_in_voxels(shape.sharp, result, seed, spacing)
        in_voxels |= edges.compare_angles(shape.mesh, nearest, shape.sharp, drawn, spacing)
    return {
        **figures,
        **edges.compare_edges(shape.sharp, edges.edge_points(drawn)),
        **in_voxels,
        **metrics.compare_triangles(mesh),
    }


def measure_on_kind(shape: Shape, mesh: Mesh) -> Measurement:
    """Return the figures of a result on a kind of grid, which has no table of edges.

    Without edges and angles it takes half the time.
    """
    return {
        **compare(shape, mesh)[0],
        "volume_off": mesh.volume() / shape.mesh.volume() - 1,
        "pieces": mesh.components()[0],
        "pieces_of_reference": shape.mesh.components()[0],
    }


def compare(
    shape: Shape, mesh: Mesh
) -> tuple[Measurement, Solid, metrics.SurfacePoints, metrics.Indices]:
    """Return the figures of every result, its solid, its points, and the shape's nearest faces."""
    result = Solid(mesh)
    drawn = metrics.sample_surface(mesh, shape.seed(RESULT_POINTS)).ordered()
    there = metrics.distance_or_dot(result, shape.drawn.points)
    back, nearest = metrics.nearest_or_dot(shape.solid, drawn.points)
    state = {"closed": mesh.is_closed(), "outward": mesh.volume() > 0, "faces": len(mesh.faces)}
    figures = metrics.compare_samples(shape.drawn, drawn)
    return {**figures, **metrics.compare_distances(there, back), **state}, result, drawn, nearest


def measure_field(case: Case | None, surface: Surface) -> Measurement:
    """Return the mean squared and absolute errors at the nodes of the band, each counted once."""
    if case is None or surface.field is None:
        return {"field_mse": None, "field_mae": None}
    error = surface.field()[case.band].astype(np.float64) - case.truth[case.band]
    return {"field_mse": float(np.mean(error**2)), "field_mae": float(np.abs(error).mean())}


@cache
def digest_of_file(path: Path) -> str:
    """Return a hash of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@cache
def digest_of_ours(model: str, precision: str = AUTO) -> str:
    """Return a hash of a network's file, of those that replace it for a kind, and of the code."""
    network, symmetries = find_model(model, precision)
    digest = hashlib.sha256(str(symmetries).encode())
    shipped = shipped_models().items()
    for_kinds = [path for name, path in shipped if float32_name(name) in KIND_MODELS]
    package = Path(super_sdf.__file__).parent
    files = sorted(package.rglob("*.py"))
    code = [p for p in files if p.relative_to(package).parts[0] not in NOT_THE_METHOD]
    for path in [network, *for_kinds, *code]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
