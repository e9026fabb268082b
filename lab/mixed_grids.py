"""A folder like those of users: grids of solids in all sizes, and some broken files.

The distances to the solids have closed forms, so meshes can be compared with the truth at every
vertex. For each kind of broken file there is the message that the failure should contain.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Placed:
    """A solid in a grid of side 1: its kind, position, rotation and size."""

    kind: str
    middle: Points
    turn: Points
    size: float

    def distance(self, points: Points) -> Points:
        """Return the signed distances (n,) of points (n, 3) in the unit cube."""
        local = (points - self.middle) @ self.turn / self.size
        return np.asarray(SOLIDS[self.kind](local) * self.size)


def ball(points: Points) -> Points:
    """Return distances to the unit ball."""
    return np.asarray(np.linalg.norm(points, axis=1) - 1)


def box(points: Points, half: tuple[float, float, float] = (0.8, 0.6, 0.4)) -> Points:
    """Return distances to a box."""
    beyond = np.abs(points) - half
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0))


def ring(points: Points) -> Points:
    """Return distances to a torus."""
    across = np.linalg.norm(points[:, :2], axis=1) - 0.7
    return np.asarray(np.hypot(across, points[:, 2]) - 0.28)


def rod(points: Points) -> Points:
    """Return distances to a capsule."""
    nearest = np.clip(points[:, 2:], -0.6, 0.6) * [0, 0, 1]
    return np.asarray(np.linalg.norm(points - nearest, axis=1) - 0.35)


def slab(points: Points) -> Points:
    """Return distances to a rounded plate."""
    return box(points, (0.7, 0.5, 0.1)) - 0.15


SOLIDS: dict[str, Callable[[Points], Points]] = {
    f.__name__: f for f in (ball, box, ring, rod, slab)
}


def random_solid(kind: str, rng: np.random.Generator) -> Placed:
    """Return a solid that stays away from the border of the grid."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Placed(kind, rng.uniform(0.48, 0.52, 3), turn, rng.uniform(0.25, 0.34))


def write_solid(solid: Placed, n: int, path: Path) -> None:
    """Sample a solid at n^3 points with spacing 1/n, and write it as .npy or .npz."""
    points = np.stack(np.indices((n,) * 3), -1).reshape(-1, 3) / n
    values = solid.distance(points).reshape((n,) * 3).astype(np.float32)
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        np.savez(path, values=values, spacing=1 / n, origin=0.0)


def write_mixed(folder: Path, count: int, sizes: list[int], seed: int = 0) -> dict[str, Placed]:
    """Write grids of all sizes and solids; return the solid that each file holds."""
    rng, solids = np.random.default_rng(seed), {}
    for i in range(count):
        n, kind = sizes[i % len(sizes)], list(SOLIDS)[i // len(sizes) % len(SOLIDS)]
        name = f"{n}/{kind}-{i:04}.np{'yz'[i % 2]}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        solids[name] = random_solid(kind, rng)
        write_solid(solids[name], n, folder / name)
    return solids


SHEARED = [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]

# Broken files, and words that the error message must contain.
BROKEN = {
    "truncated.npy": "is truncated",
    "empty.npy": "is empty",
    "pickled.npy": "holds Python objects",
    "nan.npy": "touch samples on both sides of the surface",
    "flat.npy": "give three axes",
    "labels.npy": "choose one with --label",
    "constant.npy": "a constant field has no surface",
    "unsigned.npy": "unsigned distances have no inside",
    "sheared.npz": "are not at right angles",
    "corrupt.npz": "is damaged",
}


def write_broken(folder: Path) -> None:
    """Write one file of each broken kind."""
    folder.mkdir(parents=True, exist_ok=True)
    good = folder / "good.npy"
    write_solid(random_solid("ball", np.random.default_rng(0)), 24, good)
    values, data = np.load(good), good.read_bytes()
    good.unlink()
    (folder / "truncated.npy").write_bytes(data[: len(data) // 2])
    (folder / "empty.npy").write_bytes(b"")
    np.save(folder / "pickled.npy", np.array([{}], object), allow_pickle=True)
    np.save(folder / "nan.npy", np.where(np.abs(values) < 0.02, np.nan, values))
    np.save(folder / "flat.npy", values[12])
    np.save(folder / "labels.npy", np.where(values < 0, 3, 0) + (values < -0.1))
    np.save(folder / "constant.npy", np.ones_like(values))
    np.save(folder / "unsigned.npy", np.abs(values))
    np.savez(folder / "sheared.npz", values=values, spacing=1 / 24, direction=SHEARED)
    with zipfile.ZipFile(folder / "corrupt.npz", "w") as archive:
        archive.writestr("values.npy", data)
    raw = bytearray((folder / "corrupt.npz").read_bytes())
    raw[len(raw) // 2] ^= 0xFF
    (folder / "corrupt.npz").write_bytes(raw)
