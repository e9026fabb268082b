"""Other people's methods, where their packages are installed (extra ``peers``).

They take minutes per shape, and no factor: the samples alone decide the result's resolution.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ..arrays import IntArray
from ..errors import FileError
from ..files.meshes import write_mesh
from ..grid.sdf_grid import SdfGrid
from ..mesh import Mesh
from ..network.decoder import Decoder
from ..truth.plain_ply import read_plain_ply
from ..truth.sampling import grid_points
from ..truth.solid import Points
from .cases import Case
from .methods import MESHED_METHODS, Method, Surface, simplified_to
from .names import MATCHED


def samples_of(grid: SdfGrid) -> Points:
    """Return the positions of a grid's samples, (n, 3), C order."""
    return grid_points((grid.shape, grid.voxel_size, np.array(grid.origin)))


def reach_for_the_arcs(case: Case, network: Decoder) -> Surface:
    """Mesh the grid with Reach for the Arcs (Sellán et al. 2024), with its defaults."""
    from gpytoolbox import reach_for_the_arcs

    points = samples_of(case.grid)
    vertices, faces = reach_for_the_arcs(points, np.ravel(case.grid.values).astype(np.float64))
    return Surface(Mesh(np.asarray(vertices), np.asarray(faces, np.int32)))


def dual_contouring(case: Case, network: Decoder) -> Surface:
    """Mesh the grid with Dual Contouring of Signed Distance Data (Carrera et al. 2026)."""
    from gpytoolbox import dual_contouring_of_signed_distance_data

    shape = case.grid.shape
    order = np.arange(np.prod(shape)).reshape(shape).ravel(order="F")  # there i varies fastest
    values = np.ravel(case.grid.values).astype(np.float64)[order]
    vertices, quads = dual_contouring_of_signed_distance_data(
        values, samples_of(case.grid)[order], *shape
    )
    return Surface(Mesh(np.asarray(vertices), split_quads(np.asarray(quads, np.int32))))


def split_quads(quads: IntArray) -> IntArray:
    """Return two triangles, (2 m, 3), for each quadrilateral, (m, 4)."""
    halves: IntArray = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return halves


@dataclass(frozen=True)
class Peer:
    """A peer whose meshes are kept: in the case, and in the case's folder for peers if it has one.

    Samples that are the same to the last bit have the same mesh, whoever asks for it.
    """

    name: str
    run: Method

    def __call__(self, case: Case, network: Decoder) -> Surface:
        """Return the peer's surface, the kept one if there is one."""
        surface = self.kept(case)
        if surface is None:
            clock = time.perf_counter()
            mesh = self.run(case, network).mesh
            surface = Surface(mesh, seconds=time.perf_counter() - clock)
            if case.peer_meshes:
                keep(surface, path_of(case, self.name))
            case.peers[self.name] = surface
        return surface

    def kept(self, case: Case) -> Surface | None:
        """Return the surface that was made for these samples before, if any."""
        path = path_of(case, self.name) if case.peer_meshes else None
        if self.name not in case.peers and path and path.exists():
            case.peers[self.name] = read_kept(path)
        return case.peers.get(self.name)


def path_of(case: Case, peer: str) -> Path:
    """Return the path at which the mesh of a peer is kept for a case: by its samples."""
    digest = hashlib.sha256(np.ascontiguousarray(case.grid.values, np.float32).tobytes())
    name = f"{case.shape.name}-{case.setting.size}-{peer}-{digest.hexdigest()[:12]}.ply"
    return (case.peer_meshes or Path()) / name


def keep(surface: Surface, path: Path) -> None:
    """Write a mesh, and how long it took beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".json").write_text(json.dumps({"seconds": surface.seconds}))
    write_mesh(surface.mesh, path, force=True)  # last: without it nothing is kept


def read_kept(path: Path) -> Surface:
    """Read a mesh that was kept, as it was: no vertices are merged.

    Raises
    ------
    FileError
        If it is no such mesh.
    """
    try:
        found = read_plain_ply(path)
        seconds = float(json.loads(path.with_suffix(".json").read_text())["seconds"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{path} cannot be read: {error}; remove it") from error
    if found is None:
        raise FileError(f"{path} is not a mesh that was kept: remove it")
    return Surface(Mesh(*found), seconds=seconds)


def matched_surface(case: Case, network: Decoder, *, method: Method, peer: str) -> Surface:
    """Simplify the mesh of a method to as many triangles as the peer's mesh of the case has.

    Raises
    ------
    FileError
        If the peer's mesh was made in an earlier run and not kept.
    """
    other = PEERS[peer].kept(case)
    if other is None:
        raise FileError(f"no mesh of {peer} is kept: run it again, with --peer-meshes")
    return Surface(simplified_to(method(case, network).mesh, len(other.mesh.faces)))


PEERS: dict[str, Peer] = {
    name: Peer(name, run)
    for name, run in (("rfta", reach_for_the_arcs), ("dual-contouring", dual_contouring))
}

MATCHED_METHODS: dict[str, Method] = {
    name: partial(matched_surface, method=MESHED_METHODS[ours], peer=peer)
    for name, (ours, peer) in MATCHED.items()
}
