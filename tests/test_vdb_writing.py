"""Fields as OpenVDB level sets: read back bit for bit, signs everywhere, and the bytes in the file.

``docs/guides/tools.md`` says which versions of OpenVDB have read such files.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import ball, refusal, trilinear
from test_fields import TURNED, cut_ball, tip
from test_vdb import text

from super_sdf import (SdfGrid, extract_mesh, fine_grid, make_grid, read_grid, reconstruct, upsample, write_field)
from super_sdf.errors import OptionError
from super_sdf.files.formats import find_format
from super_sdf.files.grids import open_volume
from super_sdf.files.vdb_writer import (ACTIVE_MASK, INSIDE, MIXED, OUTSIDE, LevelSet, leaf_bytes, write_tree)

PAD = 8  # voxels that are looked at beyond the lattice

pytestmark = pytest.mark.usefixtures("folder", "in_process")


def turned() -> SdfGrid:
    return make_grid(ball().values, spacing=1.0, origin=(3, -4, 5), direction=TURNED)


def stretched_mask() -> SdfGrid:
    """Return a mask with unequal spacings, which is refined on its own lattice."""
    far = (np.moveaxis(np.indices((16, 17, 12)), 0, -1) - [7.2, 8.1, 5.4]) * [1, 1, 1.5]
    return make_grid((np.linalg.norm(far, axis=-1) < 5.2).astype(np.uint8), spacing=(1, 1, 1.5))


GRIDS = {
    "whole": ball,
    "leaving": cut_ball,
    "tip": tip,
    "turned": turned,
    "stretched": stretched_mask,
}


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


def held(path, grid: SdfGrid) -> tuple[np.ndarray, np.ndarray, dict]:
    """Return the values in a file, the voxel that is the first, and what is said of the grid."""
    with open_volume(path, find_format(path), "xyz", (1, None), describes=True) as volume:
        values = volume.box(tuple(slice(0, n) for n in volume.shape))
        columns = np.array(grid.direction) * grid.spacing
        np.testing.assert_allclose(volume.direction * volume.spacing, columns, atol=1e-15)
        first = np.linalg.solve(columns, np.array(volume.origin) - grid.origin)
        np.testing.assert_allclose(first, np.rint(first), atol=1e-9)
        return values, np.rint(first).astype(int), volume.about["grids"][0]


@pytest.mark.parametrize("factor", [2, 4, 6])
@pytest.mark.parametrize("name", GRIDS)
def test_every_voxel_comes_back(name, factor):
    """Active or not, in leaves, tiles and beyond the lattice; those on the lattice bit for bit."""
    field = upsample(GRIDS[name](), trilinear, factor)
    write_field(field, "a.vdb")
    expected, background = level_set(field)
    found, first, said = held("a.vdb", fine_grid(field))
    count = int((np.abs(expected) < background).sum())
    assert said == dict(zip(said, ("surface", "float", "level set", count)))
    box = tuple(slice(f + PAD, f + PAD + n) for f, n in zip(first, found.shape))
    assert min(part.start for part in box) >= 0
    np.testing.assert_allclose(found, expected[box], rtol=1e-6)
    lattice = np.zeros(expected.shape, bool)
    lattice[PAD:-PAD, PAD:-PAD, PAD:-PAD] = True
    assert (found == expected[box])[lattice[box]].all()
    expected[box] = background
    assert (expected == background).all()  # whatever is not background was in the box


@pytest.mark.parametrize("name", GRIDS)
def test_the_level_set_is_a_grid_with_the_same_surface(name):
    """Also of a solid that leaves the grid: closed along the border, as the mesh is."""
    grid = GRIDS[name]()
    field = upsample(grid, trilinear, 4)
    write_field(field, "a.vdb")
    again = reconstruct(read_grid("a.vdb"), trilinear, 2, cap=False, mesher="marching")
    want = extract_mesh(field, cap=True, mesher="marching")
    assert again.is_closed()
    ends = [np.array([mesh.vertices.min(0), mesh.vertices.max(0)]) for mesh in (again, want)]
    fine = fine_grid(field)
    assert np.abs(ends[0] - ends[1]).max() < 0.5 * max(fine.spacing)
    assert volume(again) == pytest.approx(volume(want), rel=0.01)


def volume(mesh) -> float:
    """Return the signed volume of a mesh, by the divergence theorem."""
    corners = mesh.vertices[mesh.faces]
    return float(np.linalg.det(corners - mesh.vertices.mean(0)).sum() / 6)


def parsed(path) -> dict:
    """Return the parts of a file, read as OpenVDB's source describes them."""
    data, found = Path(path).read_bytes(), {}
    magic, found["version"], _, _, found["seekable"] = struct.unpack_from("<qIII?", data)
    assert magic == 0x56444220
    found["uuid"], place = data[21:57].decode(), 57
    assert struct.unpack_from("<II", data, place) == (0, 1)  # no metadata of the file, one grid
    place += 8
    name = text("surface") + text("Tree_float_5_4_3") + text("")
    assert data[place : place + len(name)] == name
    place += len(name)
    start, values, end = struct.unpack_from("<qqq", data, place)
    assert start == place + 24 and end == len(data)
    flags, count = struct.unpack_from("<II", data, start)
    assert flags == ACTIVE_MASK
    place, entries = start + 8, {}
    for _ in range(count):
        key, kind, value = iter_texts(data, place)
        place += 12 + len(key) + len(kind) + len(value)
        entries[key.decode()] = (kind.decode(), value)
    (size,) = struct.unpack_from("<I", data, place)
    found["map"] = data[place + 4 : place + 4 + size].decode()
    return found | {"metadata": entries, "data": data, "transform": place + 4 + size, "at": values}


def iter_texts(data: bytes, place: int):
    """Yield three strings of bytes, each after its length."""
    for _ in range(3):
        (size,) = struct.unpack_from("<I", data, place)
        yield data[place + 4 : place + 4 + size]
        place += 4 + size


def test_the_bytes_are_those_that_openvdb_expects():
    """Straight: translation, scale, size, 1/scale, 1/scale^2, 1/(2 scale); the leaves come last."""
    field = upsample(cut_ball(), trilinear, 4)
    write_field(field, "a.vdb")
    found = parsed("a.vdb")
    assert (found["version"], found["seekable"]) == (224, True)
    assert found["map"] == "UniformScaleTranslateMap"
    h, data = 0.075, found["data"]
    place = [0.85, 1.85, 2.85], *([x] * 3 for x in (h, h, 1 / h, 1 / h**2, 0.5 / h))
    vectors = np.frombuffer(data, "<f8", 18, found["transform"]).reshape(6, 3)
    np.testing.assert_allclose(vectors, place, rtol=1e-12)
    buffers, background, tiles, _ = struct.unpack_from("<IfII", data, found["transform"] + 144)
    assert (buffers, tiles) == (1, 0) and background == np.float32(3 * h)
    corner = struct.unpack_from("<3i", data, found["transform"] + 160)
    assert [x % 4096 for x in corner] == [0, 0, 0]
    said = {key: kind for key, (kind, _) in found["metadata"].items()}
    assert said == {
        "class": "string",
        "file_bbox_max": "vec3i",
        "file_bbox_min": "vec3i",
        "file_voxel_count": "int64",
        "is_saved_as_half_float": "bool",
        "name": "string",
    }
    values, _ = level_set(field)
    active = np.argwhere(np.abs(values) < background) - PAD
    box = [found["metadata"][f"file_bbox_{end}"][1] for end in ("min", "max")]
    assert struct.unpack("<3i", box[0]) == tuple(active.min(0))
    assert struct.unpack("<3i", box[1]) == tuple(active.max(0))


def test_the_values_begin_where_the_file_says():
    """All leaves are in one node: their masks end the topology, then the first mask comes again."""
    field = upsample(ball(12, 3.0), trilinear, 2)
    write_field(field, "a.vdb")
    found = parsed("a.vdb")
    values, background = level_set(field)
    cubes = np.pad(values, [(0, -count % 8) for count in values.shape], constant_values=1e9)
    x, y, z = (count // 8 for count in cubes.shape)
    near = (np.abs(cubes) < background).reshape(x, 8, y, 8, z, 8).transpose(0, 2, 4, 1, 3, 5)
    masks = [cube for cube in near.reshape(-1, 512) if cube.any()]
    packed = np.packbits(masks, axis=1, bitorder="little").tobytes()
    data, at = found["data"], found["at"]
    assert data[at - len(packed) : at + 64] == packed + packed[:64]


def test_the_map_is_a_matrix_only_where_the_axes_are_turned():
    maps = {"turned": "AffineMap", "stretched": "ScaleTranslateMap"}
    for name, kind in maps.items():
        field = upsample(GRIDS[name](), trilinear, 2)
        write_field(field, f"{name}.vdb")
        assert parsed(f"{name}.vdb")["map"] == kind
    found = parsed("turned.vdb")
    matrix = np.frombuffer(found["data"], "<f8", 16, found["transform"]).reshape(4, 4)
    fine = fine_grid(upsample(turned(), trilinear, 2))
    point = np.array([3.0, 5.0, 7.0])
    np.testing.assert_allclose(([*point, 1] @ matrix)[:3], fine.to_world(point))


def test_the_number_of_a_file_is_that_of_its_field():
    grid, moved = ball(), SdfGrid.trusted(ball().values, 1.0, (0, 0, 1))
    for name, given in (("a", grid), ("b", grid), ("c", moved)):
        write_field(upsample(given, trilinear, 2), f"{name}.vdb")
    a, b, c = (parsed(f"{name}.vdb") for name in "abc")
    assert a["data"] == b["data"] and a["uuid"] != c["uuid"]


def test_trees_of_many_nodes_have_the_right_side_everywhere(tmp_path):
    """A leaf before voxel 0, one beyond 4096, solid cubes of 128^3 and of parts of it."""
    sides = np.full((516, 41, 41), OUTSIDE, np.uint8)
    sides[1:34, 1:34, 1:34] = INSIDE  # voxels 0 to 263
    sides[0, 0, 0] = sides[515, 2, 3] = sides[20, 40, 7] = MIXED
    rng, leaves = np.random.default_rng(0), []
    for _ in range(3):
        values = rng.normal(size=512).astype(np.float32)
        leaves.append(np.where(np.abs(values) < 0.75, values, np.sign(values) * 0.75))
    packed = [leaf_bytes(values.astype("f4"), np.abs(values) < 0.75) for values in leaves]
    count = sum(int((np.abs(values) < 0.75).sum()) for values in leaves)
    box = np.full(3, -8), np.array([4119, 319, 319])
    tree = LevelSet(ball(), np.float32(0.75), sides, packed, count, box, bytes(16))
    with open("a.vdb", "wb") as file:
        write_tree(file, tree)
    expected = np.full(sides.shape, 0.75, np.float32)
    expected[sides == INSIDE] = -0.75
    found, first, _ = held("a.vdb", ball())
    at = (np.arange(n) + f + 8 for n, f in zip(found.shape, first))
    x, y, z = (np.where((i >= 0) & (i < 8 * n), i // 8, 0) for i, n in zip(at, sides.shape))
    where = np.ix_(x, y, z)
    plain = sides[where] != MIXED
    np.testing.assert_array_equal(found[plain], expected[where][plain])
    for number, place in enumerate(np.argwhere(sides == MIXED)):
        start = 8 * (place - 1) - first
        cube = found[tuple(slice(s, s + 8) for s in start)]
        np.testing.assert_array_equal(cube.ravel(), leaves[number])


def test_voxels_that_openvdb_cannot_place_are_refused():
    """Its transforms are singular if the product of the spacings is below 3e-15."""
    for spacing, seen in ((2e-6, "5e-07"), (1e32, "2.5e+31")):
        grid = SdfGrid.trusted(ball().values.astype(float) * spacing, spacing)
        assert refusal(OptionError, write_field, upsample(grid, trilinear, 4), "a.vdb") == (
            f"the voxels of the field are {seen}, and OpenVDB takes 2e-05 to 1e+30: multiply "
            "distances, spacing and origin of the grid, or write .npz"
        )
    assert not Path("a.vdb").exists()
