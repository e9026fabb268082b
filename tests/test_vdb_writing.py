"""Fields as OpenVDB level sets: read back bit for bit, signs everywhere, and the bytes in the file.

``docs/guides/tools.md`` says which versions of OpenVDB have read such files.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import ball, cut_ball, trilinear
from test_fields import tip
from test_vdb import text

from super_sdf import SdfGrid, fine_grid, make_grid, upsample, write_field
from super_sdf.files.grids import open_volume

PAD = 8  # voxels that are looked at beyond the lattice
TURNED = [[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]

pytestmark = pytest.mark.usefixtures("folder")


def turned() -> SdfGrid:
    return make_grid(ball().values, spacing=1.0, origin=(3, -4, 5), direction=TURNED)


def stretched_mask() -> SdfGrid:
    """Return a mask with unequal spacings, which is refined on its own lattice."""
    far = (np.moveaxis(np.indices((16, 17, 12)), 0, -1) - [7.2, 8.1, 5.4]) * [1, 1, 1.5]
    return make_grid((np.linalg.norm(far, axis=-1) < 5.2).astype(np.uint8), spacing=(1, 1, 1.5))


GRIDS = dict(whole=ball, leaving=cut_ball, tip=tip, turned=turned, stretched=stretched_mask)


def level_set(field) -> tuple[np.ndarray, np.float32]:
    """Return what a level set holds from voxel (-8, -8, -8) on, and its background, from formulas.

    Along each axis: no node is deeper than the border, and beyond it is the border's distance.
    """
    fine, pad = fine_grid(field), PAD
    background = np.float32(3 * fine.voxel_size)
    values = fine.values
    index = [np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in fine.shape]
    depth = np.minimum.reduce(np.meshgrid(*index, indexing="ij"))
    values = np.maximum(values, (depth * -background / 3).astype(np.float32) + np.float32(0))
    beyond = [np.maximum(np.arange(-pad, n + pad) - n + 1, 0) for n in fine.shape]
    beyond = [np.maximum(away, away[::-1]) for away in beyond]
    away = np.sqrt(sum(x**2 for x in np.meshgrid(*beyond, indexing="ij"))) * background / 3
    values = np.pad(values, pad, mode="edge")
    values = np.where(away > 0, np.hypot(values, away), values)
    return values.clip(-background, background).astype(np.float32), background


def held(path, grid: SdfGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the values in a file, and the voxel that is the first."""
    with open_volume(path) as (volume, _):
        values = volume.read()
        columns = np.array(grid.direction) * grid.spacing
        np.testing.assert_allclose(volume.direction * volume.spacing, columns, atol=1e-15)
        first = np.linalg.solve(columns, np.array(volume.origin) - grid.origin)
        np.testing.assert_allclose(first, np.rint(first), atol=1e-9)
        return values, np.rint(first).astype(int)


@pytest.mark.parametrize("factor", [2, 4, 6])
@pytest.mark.parametrize("name", GRIDS)
def test_every_voxel_comes_back(name, factor):
    """Active or not, in leaves, tiles and beyond the lattice; those on the lattice bit for bit."""
    field = upsample(GRIDS[name](), trilinear, factor)
    write_field(field, "a.vdb")
    expected, background = level_set(field)
    found, first = held("a.vdb", fine_grid(field))
    count = int((np.abs(expected) < background).sum())
    stated = text("file_voxel_count") + text("int64") + struct.pack("<Iq", 8, count)
    assert stated in Path("a.vdb").read_bytes()
    box = tuple(slice(f + PAD, f + PAD + n) for f, n in zip(first, found.shape))
    assert min(part.start for part in box) >= 0
    np.testing.assert_allclose(found, expected[box], rtol=1e-6)
    lattice = np.zeros(expected.shape, bool)
    lattice[PAD:-PAD, PAD:-PAD, PAD:-PAD] = True
    assert (found == expected[box])[lattice[box]].all()
    expected[box] = background
    assert (expected == background).all()  # whatever is not background was in the box


def test_the_head_is_the_one_that_openvdb_expects():
    """The map by scales is translation, scale, size, 1/scale, 1/scale^2, 1/(2 scale)."""
    maps = {"leaving": "UniformScaleTranslateMap", "stretched": "ScaleTranslateMap"}
    for name, kind in {**maps, "turned": "AffineMap"}.items():
        field = upsample(GRIDS[name](), trilinear, 2)
        write_field(field, f"{name}.vdb")
        data = Path(f"{name}.vdb").read_bytes()
        assert struct.unpack_from("<qIII?", data) == (0x56444220, 224, 5, 0, True)
        assert struct.unpack_from("<II", data, 57) == (0, 1)  # no metadata of the file, one grid
        assert data[65:].startswith(text("surface") + text("Tree_float_5_4_3") + text(""))
        assert b"level set" in data[:400]
        at, fine = data.index(text(kind)) + len(text(kind)), fine_grid(field)
        if name == "turned":
            matrix, point = np.frombuffer(data, "<f8", 16, at).reshape(4, 4), np.array([3.0, 5, 7])
            np.testing.assert_allclose(([*point, 1] @ matrix)[:3], fine.to_world(point))
        else:
            h = np.array(fine.spacing)
            vectors = np.frombuffer(data, "<f8", 18, at).reshape(6, 3)
            np.testing.assert_allclose(vectors, [fine.origin, h, h, 1 / h, 1 / h**2, 0.5 / h])
