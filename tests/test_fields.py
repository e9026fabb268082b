"""The refined field out: values and places against truth, round trips, both files or none."""

import os
import re
import struct
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import ball, cut_ball, refusal, trilinear
from numpy.typing import ArrayLike
from test_vdb import text

from super_sdf import (
    SdfGrid,
    extract_mesh,
    fine_grid,
    make_grid,
    read_field,
    read_grid,
    reconstruct,
    upsample,
    write_field,
    write_mesh,
)
from super_sdf.errors import FileError, OptionError, OptionTypeError, OutOfMemoryError, WriteError
from super_sdf.files import fields as writing, meshes
from super_sdf.files.grids import open_volume

SPACING, ORIGIN = 0.3, (7.0, -8.0, 9.0)


pytestmark = pytest.mark.usefixtures("folder")


def plane() -> SdfGrid:
    """Return the distances from a plane, in a grid that it leaves: trilinear is exact on them."""
    points = np.moveaxis(np.indices((12, 11, 10)), 0, -1) * SPACING + ORIGIN
    return SdfGrid.trusted(to_plane(points).astype(np.float32), SPACING, ORIGIN)


def to_plane(points: np.ndarray) -> np.ndarray:
    """Return the distances of points (..., 3) from the plane."""
    return (points - ORIGIN - 1.6) @ np.array([2.0, -1.0, 2.0]) / 3


def tip() -> SdfGrid:
    """Return a ball that crosses the border of the lattice, though no sample on it is inside."""
    ijk = np.moveaxis(np.indices((16, 15, 14)), 0, -1)
    return SdfGrid.trusted(np.linalg.norm(ijk - [10.2, 7.0, 6.6], axis=-1) - 4.9, 1.0)


def turned(step: float = 0.5) -> SdfGrid:
    """Return a ball in a grid of turned and mirrored axes, of which z has another spacing."""
    off = np.moveaxis(np.indices((14, 15, 16)), 0, -1) - [6.2, 6.9, 7.1]
    values = np.linalg.norm(off * [0.5, 0.5, step], axis=-1) - 2.05
    direction = [[0.0, 0.0, 1.0], [0.8, 0.6, 0.0], [0.6, -0.8, 0.0]]
    return make_grid(values, spacing=(0.5, 0.5, step), origin=(3, -4, 5), direction=direction)


def stretched() -> SdfGrid:
    """Return a mask with unequal spacings, which is refined on its own lattice."""
    far = (np.moveaxis(np.indices((16, 17, 12)), 0, -1) - [7.2, 8.1, 5.4]) * [1, 1, 1.5]
    return make_grid((np.linalg.norm(far, axis=-1) < 5.2).astype(np.uint8), spacing=(1, 1, 1.5))


NO_SPACE = "cannot be written: No space left on device"
GRIDS = {"whole": ball, "leaving": cut_ball, "tip": tip, "turned": turned}
GRIDS |= {"unequal": partial(turned, 0.75), "stretched": stretched}


def same(one, other) -> bool:
    return all(
        a.dtype == b.dtype and np.array_equal(a, b)
        for a, b in ((one.vertices, other.vertices), (one.faces, other.faces))
    )


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("cap, mesher", [(False, "marching"), (True, "sharp")])
def test_a_field_that_was_read_back_gives_the_same_mesh(name, cap, mesher):
    grid = GRIDS[name]()
    field, how = upsample(grid, trilinear, 4), {"cap": cap, "mesher": mesher}
    write_field(field, "field.npz")
    back, want = read_field("field.npz"), reconstruct(grid, trilinear, 4, **how)
    for given in ((back,), (field,), (back, grid)):
        assert same(want, extract_mesh(*given, **how))
    assert want.is_closed() == (cap or name != "leaving")
    assert np.array_equal(back.distances(), field.distances())
    assert np.array_equal(back.positions(), field.positions())
    write_field(back, "again.npz")
    assert Path("again.npz").read_bytes() == Path("field.npz").read_bytes()


def test_the_examples_of_the_docs_run(capsys):
    """On a plane: the first gives every node's place and value; the second a mesh."""
    write_field(upsample(plane(), trilinear, 4), "part-field.npz")
    text = (Path(__file__).parent.parent / "docs" / "reference" / "files.md").read_text()
    first, second = re.findall(r"```python\n(.*?)```", text, re.S)
    names: dict = {}
    exec(first, names)
    assert np.abs(names["values"] - to_plane(names["points"])).max() < 1e-6
    assert np.abs(to_plane(names["near"])).max() < 0.1 * SPACING + 1e-6
    assert capsys.readouterr().out.startswith(f"{len(names['values'])} blocks; ")
    exec(second, names)
    assert np.abs(names["distances"] - to_plane(names["points"])).max() < 1e-6
    want = reconstruct(plane(), trilinear, 4, mesher="sharp")
    write_mesh(want, "want.ply")
    assert Path("part-sharp.ply").read_bytes() == Path("want.ply").read_bytes()


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> dict[str, np.ndarray]:
    """Return the arrays of a field's file."""
    path = tmp_path_factory.mktemp("field") / "good.npz"
    write_field(upsample(ball(12, 3.0), trilinear, 2), path)
    return dict(np.load(path))


def damage(good: dict[str, np.ndarray], **changed: ArrayLike | None) -> str:
    """Write a field's file with some arrays changed (None: left out); return why it is refused."""
    arrays = {**good, **changed}
    np.savez("a.npz", **{key: value for key, value in arrays.items() if value is not None})
    said = refusal(FileError, read_field, "a.npz")
    start = "a.npz cannot be read as a refined field: "
    assert said.startswith(start)
    return said.removeprefix(start)


WRONG = {
    "its version is 1, and this program reads 2": {"version": 1},
    "factor is 3: give an even number from 2 to 16": {"factor": 3},
    "spacing is 0, 0, 0: give lengths from 1e-60 to 1e+60": {"spacing": np.zeros(3)},
    "its voxels are not in order": {"samples": np.ones(2, int)},
    "cannot reshape array": {"factor": 4},
    "": {"factor": None},
}


@pytest.mark.parametrize("said", WRONG)
def test_files_that_are_no_fields_are_refused_in_one_line(said, good):
    assert damage(good, **WRONG[said]).startswith(said.strip())


def test_a_lattice_that_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr("super_sdf.threads.free_memory", lambda: 10**5)
    field = upsample(ball(12, 3.0), trilinear, 4)
    said = refusal(OutOfMemoryError, write_field, field, "a.vti")
    assert said.startswith("the refined field, 117,649 values, needs ") and os.listdir() == []
    write_field(field, "a.npy")


def test_the_command_writes_the_mesh_and_the_field(command):
    np.savez("grid.npz", values=cut_ball().values, spacing=0.3, origin=[1, 2, 3])
    run = "upsample", "grid.npz", "--quality=fast"
    code, _, said = command(*run, "a.ply", "--save-field", "a.npz")
    assert code == 0
    assert said.splitlines()[-1] == "a.npz: the refined field, lattice 57 x 61 x 65"
    write_mesh(extract_mesh(read_field("a.npz")), "b.ply")
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()
    code, out, _ = command(*run, "c.ply", "--save-field", "c.npy", "--open", "--json")
    assert code == 0 and '"path": "c.npy"' in out
    write_mesh(extract_mesh(read_field("a.npz"), cap=False), "d.ply")
    assert Path("c.ply").read_bytes() == Path("d.ply").read_bytes()
    assert np.load("c.npy").shape == (57, 61, 65)


@pytest.mark.parametrize("suffix", [".npz", ".vti", ".vdb"])
@pytest.mark.parametrize("broken", ["disk", "mesh"])
def test_both_files_appear_or_neither(broken, suffix, command, monkeypatch):
    np.savez("grid.npz", values=ball().values, spacing=1.0)
    target = "field" + suffix

    def full(*_):
        raise OSError(28, "No space left on device")

    table, kind = (meshes.WRITERS, ".ply") if broken == "mesh" else (writing.FIELD_TABLE, suffix)
    monkeypatch.setitem(table, kind, full)
    run = "upsample", "grid.npz", "a.ply", "--save-field", target, "--quality=fast", "-q"
    code, _, said = command(*run)
    assert os.listdir() == ["grid.npz"]
    assert (code, said) == (1, f"Error: {'a.ply' if broken == 'mesh' else target} {NO_SPACE}\n")


def test_the_fine_lattice_is_right_also_far_from_the_surface_and_in_dense_files():
    field = upsample(plane(), trilinear, 4)
    fine = fine_grid(field)
    assert fine.shape == tuple(4 * n + 1 for n in (12, 11, 10))
    points = fine.to_world(np.moveaxis(np.indices(fine.shape), 0, -1))
    assert np.abs(points[0, 0, 0] - np.array(ORIGIN) + SPACING / 2).max() < 1e-12
    assert np.abs(fine.values - to_plane(points)).max() < 2e-6
    write_field(field, "field.npy")
    write_field(field, "field.vti")
    array, image = np.load("field.npy"), read_grid("field.vti", inside="negative")
    assert array.dtype == np.float32 and np.array_equal(array, fine.values)
    assert np.array_equal(image.values, fine.values)
    assert (image.spacing, image.origin) == (fine.spacing, fine.origin)
    jump = np.full((9, 9, 9), 5, np.float32)  # far values with no band between
    jump[3:6, 3:6, 3:6] = -5
    fine = fine_grid(upsample(SdfGrid.trusted(jump, 1.0), trilinear, 4))
    assert np.array_equal(fine.values[2::4, 2::4, 2::4] < 0, jump < 0)


def test_a_field_from_a_file_has_no_far_values(good):
    np.savez("field.npz", **good)
    back = read_field("field.npz")
    assert np.isnan(back.grid.values).all()
    for name in ("again.npy", "again.vdb"):
        assert refusal(FileError, write_field, back, name) == (
            f"{name} cannot be written: {name[5:]} needs the coarse samples, which a field from a "
            "file has not; write .npz"
        )
    assert os.listdir() == ["field.npz"]


def test_blocks_that_do_not_fit_together_are_refused(good):
    """Their mesh would have triangles of vertices that there are not."""
    said = "blocks differ at nodes that they share"
    for place in ((0, 0, 0), (0, 1, 2), (2, 1, 1)):  # a corner, an edge and a face of a block
        values = good["values"].copy()
        values[len(values) // 2][place] += 1
        assert damage(good, values=values) == said


def test_damaged_and_foreign_files_are_refused(good):
    Path("b.npz").write_bytes(b"hello")
    np.savez("grid.npz", values=np.zeros((2, 2, 2)))
    np.savez("field.npz", **good)
    data = bytearray(Path("field.npz").read_bytes())
    with zipfile.ZipFile("field.npz") as archive:
        data[archive.getinfo("values.npy").header_offset + 5000] ^= 255
    Path("flipped.npz").write_bytes(data)
    for name, said in (
        ("b.npz", "b.npz cannot be read as a refined field: File is not a zip file"),
        ("none.npz", "none.npz does not exist"),
        ("grid.npz", "grid.npz cannot be read as a refined field: 'version is not a file in the"),
        ("flipped.npz", "flipped.npz cannot be read as a refined field: Bad CRC-32"),
    ):
        assert refusal(FileError, read_field, name).startswith(said)
    assert refusal(FileError, read_grid, "field.npz") == (
        "field.npz is a refined field, no grid: mesh it with extract_mesh(read_field(path))"
    )


def test_targets_are_refused_before_anything_is_written():
    field = upsample(ball(12, 3.0), trilinear, 2)
    Path("old.npz").write_bytes(b"old")
    no_field = "field.obj is not a field file: give one of .npz, .vdb, .npy, .vti"
    assert refusal(OptionError, write_field, field, "field.obj") == no_field
    refusal(WriteError, write_field, field, "old.npz")
    refusal(OptionTypeError, write_field, 3, "field.npz")
    assert os.listdir() == ["old.npz"] and Path("old.npz").read_bytes() == b"old"
    write_field(field, "old.npz", force=True)
    assert read_field("old.npz").factor == 2


def test_image_data_lies_where_the_turned_field_does():
    field = upsample(turned(0.75), trilinear)
    write_field(field, "a.vti")
    ends = np.indices((2, 2, 2)).reshape(3, -1).T
    corners = [
        sorted(np.round(some.to_world(ends * (np.array(some.shape) - 1)), 5).tolist())
        for some in (read_grid("a.vti"), fine_grid(field))
    ]
    np.testing.assert_allclose(*corners, atol=2e-5)  # in an order that no axis decides


# Level sets of OpenVDB; ``docs/guides/tools.md`` says which versions have read such files.

PAD = 8  # voxels that are looked at beyond the lattice


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
