"""Meshes with closed forms, for the tests of what is measured against them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lab.surfaces import isosurface
from super_sdf import Mesh, write_mesh

CUBE_CORNERS = "013 032 467 475 045 051 237 276 026 064 157 173"
CUBE_FACES = np.array([[int(corner) for corner in face] for face in CUBE_CORNERS.split()], np.int32)
TORUS = 0.3, 0.12  # radii of the circle and of the tube


def box_distance(points: np.ndarray, half: ArrayLike) -> np.ndarray:
    """Return the distances of points (..., 3) from a box round the origin with these half sides."""
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


def wedge(n: int = 24) -> np.ndarray:
    """Return distances to a box with sides of three lengths, off the middle, in spacings."""
    ijk = np.moveaxis(np.indices((n, n, n)), 0, -1)
    return box_distance(ijk - [11.3, 12.1, 11.7], [8.2, 5.3, 3.1]).astype(np.float32)


def square(z: float = 0.0) -> Mesh:
    """Return the unit square at height z, two triangles looking up."""
    corners = np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def cube() -> Mesh:
    """Return the cube of side 1 round the origin, outward."""
    return Mesh(np.indices((2, 2, 2)).reshape(3, -1).T - 0.5, CUBE_FACES)


def sphere(radius: float = 0.4, size: int = 32) -> Mesh:
    """Return the isosurface of an exact sphere, as the baselines make theirs."""
    axis = np.linspace(-0.5, 0.5, size + 1, dtype=np.float32)
    field = np.sqrt(sum(x**2 for x in np.meshgrid(axis, axis, axis))) - np.float32(radius)
    return isosurface(field, 1 / size, -0.5)


def torus(around: int = 96, across: int = 48) -> Mesh:
    """Return a torus round the z axis, its vertices on the torus of radii ``TORUS``."""
    u, v = np.meshgrid(
        np.arange(around) * 2 * np.pi / around,
        np.arange(across) * 2 * np.pi / across,
        indexing="ij",
    )
    ring = TORUS[0] + TORUS[1] * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), TORUS[1] * np.sin(v)], axis=-1)
    corner = np.arange(around * across).reshape(around, across)
    right, up = np.roll(corner, -1, 0), np.roll(corner, -1, 1)
    both = np.roll(right, -1, 1)
    faces = np.stack([corner, right, both, corner, both, up], axis=-1)
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32))


def inverted(mesh: Mesh) -> Mesh:
    """Return the mesh inside out."""
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))


def joined(*meshes: Mesh) -> Mesh:
    """Return meshes as one, not merged."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), faces.astype(np.int32))


def saved(mesh: Mesh, path: Path) -> Path:
    """Write a mesh to a file."""
    write_mesh(mesh, path)
    return path
