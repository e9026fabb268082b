"""Marching cubes beside scikit-image's: scripts in which only the import is changed."""

import numpy as np
import pytest
from conftest import refusal, trilinear
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes as of_skimage

from super_sdf import marching_cubes
from super_sdf.errors import OptionError

PLACES = np.indices((24, 22, 26)).astype(np.float32)
MIDDLE = np.array([11.3, 10.2, 12.6])
BALL = np.linalg.norm(PLACES - MIDDLE[:, None, None, None], axis=0) - 7.1

LEVEL_SET = """
from skimage.draw import ellipsoid
from {home} import marching_cubes

volume = ellipsoid(6, 10, 16, levelset=True)
verts, faces, normals, values = marching_cubes(volume, 0)
corners = verts[faces]
assert len(normals) == len(values) == len(verts) and values.max() > 0
"""
NEURAL_FIELD = """
import numpy as np
import torch
from {home} import marching_cubes

n, bound = 32, 1.1
axis = torch.linspace(-bound, bound, n)
points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
sdf = (points.norm(dim=1) - 0.8).reshape(n, n, n).numpy()
voxel = 2 * bound / (n - 1)
verts, faces, normals, _ = marching_cubes(sdf, level=0.0, spacing=[voxel] * 3)
verts = verts - bound
assert abs(np.linalg.norm(verts, axis=1) - 0.8).max() < 0.01
assert ((normals * verts).sum(1) < 0).all()
corners = verts[faces]
"""
SCAN = """
import numpy as np
import trimesh
from {home} import marching_cubes

x, y, z = np.mgrid[-12:13, -14:15, -9:10]
scan = (1000 / (1 + np.exp(np.hypot(np.hypot(x, y) - 7, 1.6 * z) - 4)) - 150).astype(np.int16)
verts, faces, normals, _ = marching_cubes(
    scan, 350, spacing=(0.7, 0.7, 1.5), step_size=1, allow_degenerate=False
)
mesh = trimesh.Trimesh(verts, faces, vertex_normals=normals)
assert mesh.is_watertight and mesh.euler_number == 0
corners = mesh.triangles
"""


@pytest.mark.parametrize("script", [LEVEL_SET, NEURAL_FIELD, SCAN])
def test_only_the_import_changes(script):
    volumes = []
    for home in ("skimage.measure", "super_sdf"):
        names = {}
        exec(script.format(home=home), names)
        a, b, c = np.moveaxis(names["corners"].astype(np.float64), 1, 0)
        volumes.append(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
    assert volumes[1] == pytest.approx(volumes[0], rel=0.03)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("way", ["descent", "ascent"])
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.1, 0.2, 0.3)])
def test_vertices_winding_and_normals_are_as_there(sign, way, spacing):
    how = {"spacing": spacing, "gradient_direction": way}
    wanted = of_skimage(sign * BALL, 0.5, **how)
    found = marching_cubes(sign * BALL, 0.5, network=trilinear, factor=2, **how)
    assert [a.dtype.kind for a in found] == [a.dtype.kind for a in wanted]
    near = cKDTree(found[0]).query(wanted[0])[0]
    assert near.max() < 0.4 * max(spacing)
    sides = []
    for vertices, faces, normals, _ in (found, wanted):
        a, b, c = vertices[faces].transpose(1, 0, 2)
        outward = (a + b + c) / 3 - MIDDLE * spacing
        sides.append((np.einsum("ni,ni->n", outward, np.cross(b - a, c - a)) > 0).mean())
        assert (
            np.sign(sign * np.einsum("ni,ni->n", normals, vertices - MIDDLE * spacing)) < 0
        ).all()
    assert sides[0] == sides[1] in (0, 1)
    assert np.median(found[3]) == pytest.approx(np.median(wanted[3]), rel=0.1)


def test_without_a_level_it_is_half_way_as_there():
    values = np.clip(BALL, -3, 5)
    wanted, found = of_skimage(values)[0], marching_cubes(values, network=trilinear)[0]
    for vertices in (wanted, found):
        assert np.linalg.norm(vertices - MIDDLE, axis=1).mean() == pytest.approx(8.1, abs=0.03)


@pytest.mark.parametrize(("wrong", "said"), [
    ({"level": 99}, "level is 99: give one within the values, "),
    ({"step_size": 2}, "step_size is 2: all samples are refined, leave it out"),
    ({"mask": BALL > 0}, "mask is given: all samples are refined, leave it out"),
    ({"method": "dual"}, "method is 'dual': give one of lewiner, lorensen"),
])  # fmt: skip
def test_what_is_not_taken_is_said(wrong, said):
    assert refusal(OptionError, marching_cubes, BALL, **{"level": 0, **wrong}).startswith(said)
