"""Grids of other formats come out at the right place, side and size.

The part is a large ball with a small one beside it, off every axis of symmetry. Files are written
by the format's own library; where each sample is in the world is said by that library, or another.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
import pyvista
import SimpleITK as sitk  # noqa: N813
import tifffile
import trimesh
from conftest import ball
from numpy.typing import ArrayLike
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

from super_sdf import SdfGrid, read_grid
from super_sdf.errors import GridError
from super_sdf.files import formats

DATA = Path(__file__).parent / "data"
SPACING = 0.5
SIZES = (24, 20, 17)  # samples along the three axes of the file
CENTRE = np.array([103.0, -52.0, 17.0])
TURNS = [
    np.eye(3)[:, list(order)] * signs
    for order in itertools.permutations(range(3))
    for signs in ((1, 1, 1), (-1, -1, 1), (1, -1, 1), (-1, -1, -1))
]  # half of them mirrored


pytestmark = pytest.mark.usefixtures("folder")


def part(points: np.ndarray) -> np.ndarray:
    """Return the distances of points (..., 3) from the part."""
    large = np.linalg.norm(points - CENTRE, axis=-1) - 2.6
    small = np.linalg.norm(points - CENTRE - [1.9, 0.9, 1.3], axis=-1) - 1.1
    return np.minimum(large, small)


def affine_of(direction: np.ndarray, spacing: float = SPACING) -> np.ndarray:
    """Return the affine (4, 4) of a grid around the part with SIZES and a direction."""
    affine = np.eye(4)
    affine[:3, :3] = direction * spacing
    affine[:3, 3] = CENTRE + 0.1 - affine[:3, :3] @ (np.array(SIZES) / 2)
    return affine


def sampled(affine: np.ndarray, sizes: tuple[int, ...] = SIZES) -> np.ndarray:
    """Return the samples (ni, nj, nk) of the part at the positions that an affine gives."""
    ijk = np.moveaxis(np.indices(sizes), 0, -1)
    return part(ijk @ affine[:3, :3].T + affine[:3, 3]).astype(np.float32)


def check(grid: SdfGrid, spacing: ArrayLike = SPACING, tolerance: float = 2e-5) -> None:
    """Check that each sample of the grid is the distance at its place in the world."""
    assert np.allclose(grid.spacing, spacing, rtol=1e-5)
    assert sorted(grid.shape) == sorted(SIZES)
    places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1))
    assert np.abs(grid.values - part(places)).max() < tolerance
    assert np.array_equal(grid.planes(3, 5), grid.values[3:5])


def save_nifti(path: str, affine: np.ndarray) -> None:
    nibabel.save(nibabel.Nifti1Image(sampled(affine), affine), path)


def save_nrrd(path: str, affine: np.ndarray) -> None:
    header = {"space": "left-posterior-superior", "space directions": affine[:3, :3].T}
    nrrd.write(path, sampled(affine), {**header, "space origin": affine[:3, 3]})


def save_itk(path: str, affine: np.ndarray) -> None:
    image = sitk.GetImageFromArray(sampled(affine).T)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / spacing).ravel().tolist())
    values = sitk.GetArrayViewFromImage(image).T
    for index in ((0, 0, 0), (5, 3, 11)):  # ITK agrees where a sample is
        there = np.array(image.TransformIndexToPhysicalPoint(index))
        assert np.isclose(values[index], part(there), atol=1e-5)
    sitk.WriteImage(image, path, path.endswith(".mha"))


def save_vti(path: str, affine: np.ndarray, start: tuple[int, ...] = (3, -2, 7)) -> None:
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    place = {"origin": affine[:3, 3] - affine[:3, :3] @ start, "spacing": spacing}
    image = pyvista.ImageData(**place, direction_matrix=affine[:3, :3] / spacing)
    image.extent = [n for s, size in zip(start, SIZES) for n in (s, s + size - 1)]
    image["distance"] = part(image.points).astype(np.float32)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(path)
    writer.SetInputData(image)
    assert writer.Write()


ORIENTED = {
    "a.nii": save_nifti,
    "a.nii.gz": save_nifti,
    "a.nrrd": save_nrrd,
    "a.nhdr": save_nrrd,
    "b.nrrd": save_itk,
    "a.mha": save_itk,
    "a.mhd": save_itk,
    "a.vti": save_vti,
}


OBLIQUE = trimesh.transformations.euler_matrix(0.3, -0.2, 0.5)[:3, :3]


@pytest.mark.parametrize("turn", range(0, len(TURNS), 5))
@pytest.mark.parametrize("name", ORIENTED)
def test_axes_in_any_order_and_direction_with_any_spacing(name, turn):
    ORIENTED[name](name, affine_of(TURNS[turn] @ np.diag([1, 1.4, 1.8])))
    check(read_grid(name), np.array([0.5, 0.7, 0.9])[np.abs(TURNS[turn]).argmax(1)])


@pytest.mark.parametrize("turn", [0, 7])
@pytest.mark.parametrize("name", ORIENTED)
def test_an_oblique_grid_keeps_its_direction(name, turn):
    """The axes come in the order and sense in which they are nearest to the world's."""
    ORIENTED[name](name, affine_of(OBLIQUE @ TURNS[turn]))
    grid = read_grid(name)
    check(grid)
    assert np.allclose(grid.direction, OBLIQUE, atol=1e-5)


@pytest.mark.parametrize("name", ["a.nii", "a.nrrd"])
def test_a_sheared_grid_is_refused(name):
    shear = np.eye(3)
    shear[:, 1] = [0.6, 0.8, 0]
    ORIENTED[name](name, affine_of(shear))
    with pytest.raises(GridError, match=r"not at right angles; give unit vectors at right") as said:
        read_grid(name)
    assert str(said.value).startswith(f"{name}: direction is ")


def test_a_direction_is_given_where_the_file_has_none():
    affine = affine_of(OBLIQUE)
    place = {"spacing": 0.5, "origin": affine[:3, 3], "direction": OBLIQUE}
    np.save("c.npy", np.ascontiguousarray(sampled(affine)))
    np.save("zyx.npy", sampled(affine).T)
    np.savez("a.npz", values=sampled(affine), **place)
    tifffile.imwrite("a.tif", sampled(affine).T, photometric="minisblack")
    with h5py.File("a.h5", "w") as file:
        for name, direction in (("field", np.eye(3)[::-1]), ("turned", OBLIQUE)):
            file[name] = sampled(affine).T
            file[name].attrs.update({**place, "direction": direction.ravel()})
    for name, options in (
        ("c.npy", place),
        ("zyx.npy", {**place, "axes": "zyx"}),
        ("a.tif", place),
        ("a.h5:/field", place),  # what is given replaces what is stated
        ("a.npz", {}),
        ("a.h5:/turned", {}),
    ):
        grid = read_grid(name, **options)
        check(grid)
        assert np.allclose(grid.direction, OBLIQUE)
    assert read_grid("a.npz", direction=np.eye(3)).is_straight


def text_sdf(affine: np.ndarray) -> str:
    """Return the text that SDFGen's main.cpp writes: endl after each value, i fastest."""
    origin = " ".join(map(str, affine[:3, 3]))
    head = "{} {} {}\n".format(*SIZES) + f"{origin}\n{SPACING}\n"
    return head + "".join(f"{value:.6g}\n" for value in sampled(affine).ravel("F"))


def test_three_dialects_of_sdf():
    affine = affine_of(np.eye(3))
    values, low = sampled(affine), affine[:3, 3].astype("<f4")
    Path("text.sdf").write_text(text_sdf(affine))
    check(read_grid("text.sdf"))
    tag = "#sdf 1\ndim {} {} {}\ndata\n".format(*SIZES).encode()
    Path("tagged.sdf").write_bytes(tag + values.tobytes())
    check(read_grid("tagged.sdf", spacing=SPACING, origin=low))
    high = (low + np.array(SIZES) * SPACING).astype("<f4")
    head = np.array(SIZES, "<i4").tobytes() + low.tobytes() + high.tobytes()
    Path("boxed.sdf").write_bytes(head + values.tobytes())
    check(read_grid("boxed.sdf"))


def test_a_given_spacing_and_origin_replace_those_of_the_file():
    """The origin is that of the file's sample (0, 0, 0), also if its axes run backwards."""
    affine = affine_of(np.diag([-1.0, 1.0, -1.0]))
    nibabel.save(nibabel.Nifti1Image(sampled(affine), np.diag([-3, 2, -1, 1])), "a.nii")
    check(read_grid("a.nii", spacing=SPACING, origin=affine[:3, 3]))


def test_a_mesh_as_input_is_told_to_be_sampled_first(command):
    want = (
        "Error: part.stl is a mesh, not a grid: sample it first with super-sdf sample part.stl "
        "part.npz -n 64\n"
    )
    assert command("upsample", "part.stl", "out.ply")[::2] == (2, want)
    assert command("upsample", "part.step", "out.ply")[2] == (
        "Error: part.step is a CAD model: export it as part.stl, then super-sdf sample part.stl "
        "part.npz -n 64\n"
    )


def test_special_files_and_folders_are_refused(command):
    os.mkdir("a.nii")
    os.mkdir("a.zarr")
    for name, said in {
        "a.nii": "is a folder: give a file",
        "a.zarr": "is no Zarr store: it holds none of zarr.json, .zarray, .zgroup",
        "no.zarr": "does not exist",
    }.items():
        assert command("upsample", name, "o.ply")[2] == f"Error: {name} {said}\n"


def test_components_and_missing_axes_are_refused():
    sitk.WriteImage(sitk.Image([4, 4, 4], sitk.sitkVectorFloat32, 3), "v.mha")
    tifffile.imwrite("rgb.tif", np.zeros((5, 6, 7, 3), np.uint8), photometric="rgb")
    nrrd.write("two.nrrd", np.zeros((4, 5)))
    for name in ("v.mha", "rgb.tif", "two.nrrd"):
        with pytest.raises(GridError, match=f"{name} has .*: give a (file|stack) of three axes"):
            read_grid(name)


def test_the_page_on_formats_lists_those_of_the_table():
    page = (Path(__file__).parent.parent / "docs" / "guides" / "formats.md").read_text()
    for format_ in (*formats.FORMATS, formats.DICOM):
        start = f"| {format_.name} | `{'`, `'.join(format_.suffixes)}` | "
        assert start + (f"`{format_.extra}`" if format_.extra else "none") in page


@pytest.mark.parametrize("dtype", [">f4", "<f8", "f2", ">i4", "i8", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_dtype_and_order_is_read(dtype, order):
    values = np.clip(ball().values * 8, -120, 120).astype(dtype)
    np.save("in.npy", np.asarray(values, order=order))
    np.testing.assert_array_equal(read_grid("in.npy", spacing=8).values, values)
