"""Masks and truncated distances on grids with thick slices, as CT and MR images have them.

    python -m benchmarks.thick_slices PARTS
    python -m benchmarks.thick_slices PARTS --count 6 -n 24 --ratios 1.5 2.5 5 --kinds mask

PARTS holds meshes. Each is turned, scaled to a box diagonal of 1 and sampled with n samples along z
and more along x and y. Of a mask, "ours" is the grid as it is, and the others are

    marching cubes      of the mask as it is
    nearest, ours       each slice repeated to the finest spacing, then meshed as a mask
    between, ours       distances between samples, interpolated linearly to the finest spacing
                        (shape-based interpolation), and the mask of their sign meshed

Other kinds are compared with marching cubes alone. "cut off" is in spacings of the slices. The
error is the mean of the distances from mesh to truth and back, in spacings of the slices. Needs the
extra eval.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.fields import distance
from super_sdf import load_network, make_grid, reconstruct
from super_sdf.certificate.surface import count_components
from super_sdf.evaluation.cases import Shape
from super_sdf.evaluation.field_kinds import sample_box
from super_sdf.evaluation.field_methods import closed_isosurface
from super_sdf.mesh import Mesh
from super_sdf.network.decoder import Decoder

Floats = NDArray[np.float64]
CUTS = (0.5, 1.0, 2.0)  # spacings of the slices


class Score(NamedTuple):
    """How far a mesh is from the truth, in slices; its volume over the true one; its pieces."""

    distance: float
    volume: float
    pieces: int


def score(truth: Mesh, mesh: Mesh, spacing: float) -> Score:
    """Compare a mesh with the true surface."""
    pieces = count_components(mesh.faces, len(mesh.vertices))
    return Score(distance(truth, mesh, spacing), mesh.volume() / truth.volume(), pieces)


def placed(mesh: Mesh, spacing: Floats) -> Mesh:
    """Return a mesh in indices at its place in the unit cube."""
    return Mesh((np.asarray(mesh.vertices) + 0.5) * spacing - 0.5, mesh.faces)


def cubes_of(values: NDArray[np.float64], spacing: Floats) -> Mesh:
    """Return marching cubes of samples whose spacings differ."""
    return placed(closed_isosurface(values, 1.0, 0.0), spacing)


def ours(values: NDArray[np.float64], spacing: Floats, network: Decoder) -> Mesh:
    """Return the mesh of super-sdf, of a mask or of distances."""
    grid = make_grid(values, spacing=spacing, origin=spacing / 2 - 0.5)
    return reconstruct(grid, network, cap=True)


def sliced(values: NDArray[np.float64], ratio: float, order: int) -> Floats:
    """Return samples interpolated along z to the finest spacing, by splines of an order."""
    count = values.shape[2]
    z = (np.arange(round(count * ratio)) + 0.5) / ratio - 0.5
    at = np.stack(np.meshgrid(*(np.arange(n) for n in values.shape[:2]), z, indexing="ij"))
    return ndimage.map_coordinates(values, at, order=order, mode="nearest")


def between_samples(inside: NDArray[np.bool_], spacing: Floats) -> Floats:
    """Return the distance of each sample to the nearest of the other side, negative inside."""
    out, into = (
        ndimage.distance_transform_edt(side, sampling=spacing) for side in (~inside, inside)
    )
    return out - into


Methods = Iterator[tuple[str, Mesh]]


def mask_methods(values: Floats, spacing: Floats, network: Decoder) -> Methods:
    """Yield the meshes of a mask."""
    inside, ratio = values <= 0, float(spacing[2] / spacing[0])
    finest = np.full(3, spacing[0])
    yield "mask: marching cubes", cubes_of(0.5 - inside, spacing)
    repeated = sliced(inside.astype(float), ratio, 0) > 0.5
    yield "mask: nearest, ours", ours(repeated, finest, network)
    between = sliced(between_samples(inside, spacing), ratio, 1) <= 0
    yield "mask: between, ours", ours(between, finest, network)
    yield "mask: ours", ours(inside, spacing, network)


def truncated_methods(values: Floats, spacing: Floats, network: Decoder) -> Methods:
    """Yield the meshes of exact distances, and of distances that are cut off."""
    yield "exact: marching cubes", cubes_of(values, spacing)
    yield "exact: ours", ours(values, spacing, network)
    for cut in CUTS:
        clipped = np.clip(values, -cut * spacing[2], cut * spacing[2])
        yield f"cut off at {cut:g}: marching cubes", cubes_of(clipped, spacing)
        yield f"cut off at {cut:g}: ours", ours(clipped, spacing, network)


KINDS = {"mask": mask_methods, "truncated": truncated_methods}


def main() -> None:
    """Measure all shapes and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=6, help="shapes, spread evenly over all")
    parser.add_argument("-n", type=int, default=24, help="slices")
    parser.add_argument("--ratios", type=float, nargs="+", default=[1.5, 2.5, 5.0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    options = parser.parse_args()
    paths = sorted(options.folder.glob("*.ply"))
    chosen = np.unique(np.linspace(0, len(paths) - 1, options.count).astype(int))
    network, n = load_network(device="cpu"), options.n
    found: dict[tuple[float, str], list[Score]] = {}
    for path in (paths[i] for i in chosen):
        shape = Shape.read(path, 0)
        for ratio in options.ratios:
            fine = round(n * ratio)
            values = sample_box(shape.solid, (fine, fine, n), 1.0).astype(float)
            spacing = 1 / np.array(values.shape)
            for kind in options.kinds:
                for name, mesh in KINDS[kind](values, spacing, network):
                    one = score(shape.mesh, mesh, float(spacing[2]))
                    found.setdefault((ratio, name), []).append(one)
                    print(path.stem, ratio, name, f"{one.distance:.4f}", flush=True)
    print("\n| | error | largest | volume off, most | pieces |\n| --- |" + " ---: |" * 4)
    for (ratio, name), scores in found.items():
        far = [one.distance for one in scores]
        off = max(abs(one.volume - 1) for one in scores)
        pieces = sum(one.pieces for one in scores)
        print(
            f"| 1:1:{ratio:g}, {name} | {np.mean(far):.4f} | {max(far):.4f} | {off:.1%} | "
            f"{pieces} |"
        )


if __name__ == "__main__":
    main()
