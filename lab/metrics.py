"""The metrics: what is measured of a result, how it is shown, and what it means.

``METRICS`` is the table. To add a metric, add an entry: its function is given a ``Comparison``, and
the results, the tables and the explanations in reports and documents are made from the entry.
Lengths are in units of the reference's box diagonal, but where "voxels" is said: those are of the
coarse grid.

References
----------
Chen and Zhang, Neural Marching Cubes (2021): F1 at 0.003; edge points, ECD and EF1 at 0.005.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from trimesh.triangles import angles

from super_sdf.arrays import BoolArray, dot, face_normals
from super_sdf.evaluation import F1_DISTANCE, FIGURES, Comparison as Pair, Distances

from .shapes import Shape

SLIVER_ANGLE = 5.0  # degrees
NO_NORMAL_ANGLE = 90.0  # of the dot, which has no normal: the mean over all directions


@dataclass(frozen=True, eq=False)
class Comparison(Pair):
    """A result beside its reference, a shape, and how it was made."""

    reference: Shape
    field_off: Distances | tuple[()] = ()  # errors at the fine nodes of the band, each counted once
    seconds: float = 0.0  # from the grid in memory to the mesh in memory

    @cached_property
    def angles(self) -> tuple[Distances, BoolArray]:
        """Degrees between normals of Q and of the nearest triangles; whether edges are in a voxel.

        Points whose triangle has no area, and so no normal, are left out.
        """
        sharp, (points, own) = len(self.reference.edges) > 0, self.result.drawn
        if self.spacing is None:
            return np.zeros(0), np.zeros(0, bool)
        if not own.any():
            near = np.array([False, True] if sharp else [False])
            return np.full(len(near), NO_NORMAL_ANGLE), near
        mesh = self.reference.mesh
        vectors = face_normals(mesh.vertices, mesh.faces)[self.back[1]]
        lengths = np.linalg.norm(vectors, axis=1)
        known = lengths > 0
        cosines = dot(vectors, own)[known] / lengths[known]
        near = np.zeros(len(points), bool)
        if sharp:
            near = self.reference.to_edges(points) < self.spacing
        return np.degrees(np.arccos(np.clip(cosines, -1, 1))), near[known]

    @cached_property
    def least_angles(self) -> Distances:
        """The smallest angle of each triangle, in degrees; 0 without area."""
        return np.degrees(angles(self.mesh.vertices[self.mesh.faces].astype(float)).min(1))


def mean(values: Distances | BoolArray) -> float | None:
    return float(values.mean()) if len(values) else None


def quantile(distances: Distances) -> float:
    return float(np.quantile(distances, 0.99))


def edge_distance(c: Comparison) -> float | None:
    if c.spacing is None or not len(c.reference.edges):
        return None
    return float(c.result.solid.distance(c.reference.drawn_from_edges).mean() / c.spacing)


Measure = Callable[[Comparison], "float | None"]


@dataclass(frozen=True)
class Column:
    """A column of a table: the figure that it shows, its title, scale and rounding."""

    key: str
    title: str = ""
    scale: float = 1.0
    digits: int = 3

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the figure of a row as text, "-" if it is unknown."""
        figure = row.get(self.key)
        if figure is None or isinstance(figure, str):
            return figure or "-"
        return f"{figure * self.scale:,.{self.digits}f}"


@dataclass(frozen=True)
class Metric(Column):
    """A figure of every result: how it is measured, where it shows, and what it means."""

    of: Measure | None = None  # None: made of other figures, by `evaluate` and `figures`
    tables: str = ""  # in which it shows; of "surface", "edges" those of `evaluate`
    meaning: str = ""
    better: str = "lower"
    gap: str = ""  # what a report calls it that says how far its gap to the bound is closed
    counted: bool = False  # whether it is true or false: tables show of how many shapes it is true

    def cell(self, row: Mapping[str, Any]) -> str:
        if self.counted and self.key in row:
            return f"{row[self.key]} of {row['shapes']}"
        return super().cell(row)


ALL_METRICS = (
    Metric("cd", "CD x1e5", 1e5, of=FIGURES["cd"], tables="surface settings",
           meaning="Chamfer distance: mean squared distance to the nearest point, both ways"),
    Metric("excess_cd", "excess CD x1e5", 1e5, tables="surface",
           meaning="CD less that of two samplings of the reference"),
    Metric("f1", "F1", of=FIGURES["f1"], better="higher", gap="F1",
           tables="surface summary networks settings parts", meaning="harmonic mean of the shares "
           "of points that are within 0.003 of the other surface"),
    Metric("recall", of=lambda c: mean(c.near[0][0] < F1_DISTANCE)),
    Metric("precision", of=lambda c: mean(c.near[0][1] < F1_DISTANCE)),
    Metric("nc", "NC", digits=4, of=FIGURES["nc"], better="higher", gap="NC",
           tables="surface summary networks settings parts", meaning="normal consistency: mean "
           "absolute cosine between a point's normal and that of the nearest point"),
    Metric("signed_nc", "signed NC", of=lambda c: sum(map(np.mean, c.cosines)) / 2,
           tables="surface", better="higher", meaning="NC with the sign of the cosine"),
    Metric("p2s", "p2s x1e4", 1e4, 2, of=FIGURES["p2s"],
           tables="surface settings", gap="point to surface",
           meaning="mean distance from point to triangle, both ways"),
    Metric("p2s_there", "ref to res", 1e4, 2, of=lambda c: mean(c.there),
           tables="surface networks parts simplify",
           meaning="p2s from the reference to the result"),
    Metric("p2s_back", "res to ref", 1e4, 2, of=lambda c: mean(c.back[0]),
           tables="surface networks settings parts simplify", gap="result to reference",
           meaning="p2s from the result to the reference"),
    Metric("p99", "p99 x1e4", 1e4, 1, of=lambda c: (quantile(c.there) + quantile(c.back[0])) / 2,
           tables="surface", meaning="99th percentile of these distances"),
    Metric("p99_there", of=lambda c: quantile(c.there)),
    Metric("p99_back", of=lambda c: quantile(c.back[0])),
    Metric("max", "max x1e4", 1e4, 0, of=FIGURES["max"],
           tables="surface", meaning="largest of these distances"),
    Metric("max_there", of=lambda c: c.there.max()),
    Metric("max_back", of=lambda c: c.back[0].max()),
    Metric("ecd", "ECD x1e5", 1e5, 2, of=FIGURES["ecd"],
           tables="surface", meaning="CD of points at sharp edges, those of over 30 degrees"),
    Metric("ef1", "EF1", of=FIGURES["ef1"],
           tables="surface networks edges parts", better="higher",
           meaning="F1 of points at sharp edges, within 0.005"),
    Metric("efv", "EFv", of=FIGURES["efv"], tables="edges parts", better="higher",
           meaning="F1 of points on the sharp edges of both meshes, within a tenth of a voxel"),
    Metric("edge_distance", "edge distance", of=edge_distance, tables="edges parts",
           meaning="mean distance of the true sharp edges to the mesh, in voxels"),
    Metric("angle_near", "angle near", digits=2, of=lambda c: mean(c.angles[0][c.angles[1]]),
           tables="edges parts", meaning="mean angle between the normals of the mesh and those of "
           "the nearest true triangles, in degrees, within a voxel of a true sharp edge"),
    Metric("angle_beyond", "angle beyond", digits=2, of=lambda c: mean(c.angles[0][~c.angles[1]]),
           tables="edges parts", meaning="the same farther from sharp edges"),
    Metric("field_mse", "field MSE x1e6", 1e6, of=lambda c: mean(np.square(c.field_off)),
           tables="surface", meaning="mean squared error of the refined values near the surface"),
    Metric("field_mae", "field MAE x1e4", 1e4, 2, of=lambda c: mean(np.abs(c.field_off)),
           tables="surface networks", meaning="mean absolute error of these values"),
    Metric("left", "triangles left %", 100, 1, tables="simplify"),
    Metric("faces", "triangles", digits=0, of=lambda c: len(c.mesh.faces), better="-",
           tables="surface edges parts simplify", meaning="how many the mesh has"),
    Metric("slivers", "slivers %", 100, 2, of=lambda c: mean(c.least_angles < SLIVER_ANGLE),
           tables="edges parts simplify",
           meaning="share of triangles with an angle under 5 degrees"),
    Metric("min_angle", "min angle", digits=2, better="higher", tables="edges",
           of=lambda c: c.least_angles.min() if len(c.mesh.faces) else None,
           meaning="smallest angle of a triangle, in degrees"),
    Metric("gap_f1", "F1 gap closed %", 100, 0, tables="networks settings", better="higher",
           meaning="share of the way from B-spline to the bound"),
    Metric("seconds", "seconds", digits=2, of=lambda c: c.seconds, tables="peers",
           meaning="time from the grid in memory to the mesh in memory"),
    Metric("outward", of=lambda c: c.mesh.volume() > 0, counted=True),
    Metric("closed", "closed", of=lambda c: c.mesh.is_closed(), counted=True, better="higher",
           tables="surface networks settings edges parts simplify",
           meaning="meshes without an open edge"),
)  # fmt: skip
METRICS = {metric.key: metric for metric in ALL_METRICS}
# Of results on kinds of grids, which have tables of their own: without edges in half the time.
OF_KINDS: dict[str, Measure] = {
    "p2s": METRICS["p2s"].of,
    "closed": METRICS["closed"].of,
    "volume_off": lambda c: c.mesh.volume() / c.reference.mesh.volume() - 1,
    "pieces": lambda c: c.mesh.components()[0],
    "pieces_of_reference": lambda c: c.reference.pieces,
}


def shown_in(tables: str) -> list[Metric]:
    """Return the metrics that show in any of some tables, in their order."""
    wanted = set(tables.split())
    return [metric for metric in METRICS.values() if wanted & set(metric.tables.split())]
