"""Grid files, each read here and by another library: place, size, side and values.

    python -m benchmarks.readers

Prints the table of docs/formats.md. A part without any symmetry is written by the library that
people have for the format. The other library says where each sample lies and what its value is;
"off" is how far, in spacings, the grid that is read here has a sample with this value from there.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import nibabel
import nrrd
import numpy as np
import pyvista
import SimpleITK as sitk  # noqa: N813
import tifffile
import xarray
from numpy.typing import NDArray
from PIL import Image

from super_sdf import read_grid

SIZES = 20, 17, 14
STEPS = np.array([0.3, 0.4, 0.6])
FIRST = np.array([10.0, -4.0, 30.0])
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
RAS = np.diag([-1.0, -1.0, 1.0])  # from the LPS of ITK
Array = NDArray[Any]
Located = tuple[Array, Callable[[Array], Array]]
"""Values along axes i, j, k, and a function from indices (n, 3) to positions."""


@dataclass
class Case:
    """A kind of file: how it is written, and how another library reads it."""

    name: str
    file: str
    writer: str
    other: str
    write: Callable[[str, Array], object]
    read: Callable[[str], Located]


def samples() -> Array:
    """Return the distances (nx, ny, nz) of a large ball and a small one, of which no two agree."""
    places = np.moveaxis(np.indices(SIZES), 0, -1) * STEPS
    large = np.linalg.norm(places - [2.9, 3.2, 4.1], axis=-1) - 2.1
    small = np.linalg.norm(places - [4.3, 3.8, 5.2], axis=-1) - 0.9
    values: Array = np.minimum(large, small).astype(np.float32)
    return values


def affine(turn: Array, first: Array = FIRST) -> Array:
    """Return the affine (4, 4) of a grid with the spacings, turned."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn * STEPS, first
    return found


def by_itk(path: str, turn: Array | None = None) -> Located:
    """Return what ITK reads; its positions are turned if the file's own are not in LPS."""
    image = sitk.ReadImage(path)
    while image.GetDimension() > 3:
        image = image[..., 0]
    turn = np.eye(3) if turn is None else turn

    def place(indices: Array) -> Array:
        places = [image.TransformContinuousIndexToPhysicalPoint(i.tolist()) for i in 1.0 * indices]
        found: Array = np.array(places) @ turn.T
        return found

    return sitk.GetArrayViewFromImage(image).T, place


def by_nibabel(path: str) -> Located:
    """Return what nibabel reads."""
    image: Any = nibabel.load(path)
    return image.get_fdata(), lambda i: nibabel.affines.apply_affine(image.affine, i)


def by_vtk(path: str) -> Located:
    """Return what VTK reads of image data: its first array, of points or of cells."""
    image = pyvista.read(path)
    of_cells = bool(image.cell_data)
    data = image.cell_data if of_cells else image.point_data
    at = image.cell_centers().points if of_cells else image.points
    sizes = np.array(image.dimensions) - of_cells
    places = np.asarray(at).reshape(*sizes[::-1], 3).transpose(2, 1, 0, 3)
    values = np.asarray(data["sdf"]).reshape(*sizes[::-1]).T
    return values, lambda indices: places[tuple(indices.T)]


def by_xarray(path: str) -> Located:
    """Return what xarray reads of a Zarr store."""
    array = xarray.open_zarr(path).sdf.squeeze(drop=True).transpose("x", "y", "z")
    along = [array[name].values for name in "xyz"]
    return array.values, lambda i: np.stack([p[n] for p, n in zip(along, i.T)], axis=-1)


def by_pillow(path: str) -> Located:
    """Return the pages that Pillow reads, whose tags state x and y; z is what was written."""
    image = Image.open(path)
    pages = []
    for number in range(image.n_frames):
        image.seek(number)
        pages.append(np.asarray(image))
    pixels = [1 / float(image.tag_v2[tag]) for tag in (282, 283)]
    return np.stack(pages).T, lambda indices: indices * [*pixels, STEPS[2]]


def write_itk(path: str, values: Array, turn: Array, packed: bool = False) -> None:
    """Write an image with ITK."""
    image = sitk.GetImageFromArray(values.T)
    image.SetSpacing(STEPS.tolist())
    image.SetOrigin(FIRST.tolist())
    image.SetDirection(turn.ravel().tolist())
    sitk.WriteImage(image, path, packed)


def write_nifti(path: str, values: Array, turn: Array, kind: Any = nibabel.Nifti1Image) -> None:
    """Write an image with nibabel."""
    nibabel.save(kind(values, affine(turn)), path)


def write_second(path: str, values: Array) -> None:
    """Write a NIfTI-2 file, its axes in another order."""
    write_nifti(path, values, np.eye(3)[:, [2, 0, 1]], nibabel.Nifti2Image)


def write_without_place(path: str, values: Array) -> None:
    """Write a NIfTI file whose sform and qform have code 0."""
    image = nibabel.Nifti1Image(values, None)
    image.header.set_zooms(STEPS)
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    nibabel.save(image, path)


def write_nrrd(path: str, values: Array, **header: Any) -> None:
    """Write a file with pynrrd."""
    nrrd.write(path, values, header)


def write_vti(path: str, values: Array, of_cells: bool) -> None:
    """Write image data with PyVista."""
    sizes = [n + of_cells for n in values.shape]
    image = pyvista.ImageData(dimensions=sizes, spacing=STEPS, origin=FIRST)
    (image.cell_data if of_cells else image.point_data)["sdf"] = values.ravel("F")
    image.save(path)


def write_zarr(path: str, values: Array, form: int, down: str) -> None:
    """Write a store with xarray, one axis falling."""
    along = {n: f + s * np.arange(c) for n, f, s, c in zip("xyz", FIRST, STEPS, values.shape)}
    array = xarray.DataArray(values, along, ["x", "y", "z"], name="sdf")
    array = array.isel({down: slice(None, None, -1)}).expand_dims(time=[0]).transpose("y", ...)
    array.to_dataset().to_zarr(path, zarr_format=form, consolidated=False)


def write_tiff(path: str, values: Array) -> None:
    """Write an ImageJ stack with tifffile."""
    about = {"axes": "ZYX", "spacing": STEPS[2], "unit": "um"}
    options: dict[str, Any] = {"resolution": tuple(1 / STEPS[:2]), "metadata": about}
    tifffile.imwrite(path, values.T, imagej=True, **options)


def cases() -> list[Case]:
    """Return the kinds of files."""
    flipped, slow = np.diag([-1.0, 1.0, -1.0]), np.eye(3)[:, [2, 0, 1]]
    ras, none = (lambda path: by_itk(path, RAS)), np.array([np.nan] * 3)
    listed = {
        "space": "left-posterior-superior",
        "kinds": ["list", "domain", "domain", "domain"],
        "space directions": np.vstack([none, np.diag(STEPS)]),
        "space origin": FIRST,
    }
    spaced = {"spacings": STEPS, "axis mins": FIRST}
    nifti = [
        ("NIfTI, oblique", "a.nii", lambda p, v: write_nifti(p, v, TURN), ras),
        (
            "NIfTI, packed, two axes backwards",
            "a.nii.gz",
            lambda p, v: write_nifti(p, v, flipped),
            ras,
        ),
        ("NIfTI, both codes 0", "c.nii", write_without_place, by_itk),
    ]
    nrrds = [
        (
            "NRRD, `axis mins` beside `spacings`",
            "a.nrrd",
            lambda p, v: write_nrrd(p, v, **spaced),
        ),
        ("NRRD, a list axis of length 1", "b.nrrd", lambda p, v: write_nrrd(p, v[None], **listed)),
    ]
    metas = [
        ("MetaImage, oblique", "a.mha", lambda p, v: write_itk(p, v, TURN)),
        ("MetaImage, packed, turned", "b.mha", lambda p, v: write_itk(p, v, slow, True)),
        ("NRRD by ITK, oblique", "c.nrrd", lambda p, v: write_itk(p, v, TURN)),
    ]
    vtis = [
        ("VTK image data, points", "a.vti", lambda p, v: write_vti(p, v, False)),
        ("VTK image data, cells", "b.vti", lambda p, v: write_vti(p, v, True)),
    ]
    zarrs = [
        ("Zarr 2, y falling", "a.zarr", lambda p, v: write_zarr(p, v, 2, "y")),
        ("Zarr 3, z falling", "b.zarr", lambda p, v: write_zarr(p, v, 3, "z")),
    ]
    found = [Case(n, f, "nibabel", "SimpleITK", w, r) for n, f, w, r in nifti]
    found.append(Case("NIfTI-2", "b.nii", "nibabel", "nibabel", write_second, by_nibabel))
    found += [Case(n, f, "pynrrd", "SimpleITK", w, by_itk) for n, f, w in nrrds]
    found += [Case(n, f, "SimpleITK", "SimpleITK", w, by_itk) for n, f, w in metas]
    found += [Case(n, f, "vtk", "vtk", w, by_vtk) for n, f, w in vtis]
    found += [Case(n, f, "xarray", "xarray", w, by_xarray) for n, f, w in zarrs]
    return [
        *found,
        Case("TIFF by ImageJ's rules", "a.tif", "tifffile", "pillow", write_tiff, by_pillow),
    ]


def row(case: Case) -> str:
    """Write and read a file; return a row of the table."""
    case.write(case.file, samples())
    grid = read_grid(case.file)
    values, place = case.read(case.file)
    indices = np.random.default_rng(0).integers(0, values.shape, (500, 3))
    ijk = grid.to_index(place(indices))
    near = np.clip(np.rint(ijk).astype(int), 0, np.array(grid.shape) - 1)
    off = np.abs(ijk - near).max()
    worst = np.abs(grid.values[tuple(near.T)] - values[tuple(indices.T)]).max()
    sizes = "the same" if sorted(grid.shape) == sorted(values.shape) else "other"
    named = " | ".join(f"{name} {version(name)}" for name in (case.writer, case.other))
    return f"| {case.name} | {named} | {sizes} | {off:.0e} | {worst:.0e} |"


def main() -> None:
    """Print the table."""
    print("| file | written by | compared with | sizes | off, in spacings | values differ by |")
    print("| --- | --- | --- | --- | ---: | ---: |")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for case in cases():
            print(row(case))


if __name__ == "__main__":
    main()
