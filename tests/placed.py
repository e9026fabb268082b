"""A part without symmetry, and files of its samples, most by the format's own library.

The part is a large ball with a small one beside it. Where each sample is in the world is what the
library says that wrote the file.
"""

from __future__ import annotations

import gzip
import itertools
import os
from pathlib import Path
from typing import Any

import h5py
import hdf5storage
import mrcfile
import nibabel
import nrrd
import numpy as np
import pydicom
import pyvista
import scipy.io
import SimpleITK as sitk  # noqa: N813
import tifffile
import trimesh
import xarray as xr
from numpy.typing import ArrayLike
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from vtkmodules.vtkIOHDF import vtkHDFWriter

from super_sdf import SdfGrid

DATA = Path(__file__).parent / "data"
SIZES = (24, 20, 17)  # samples along the three axes of the file
STEPS = np.array([0.5, 0.7, 0.9])
CENTRE = np.array([103.0, -52.0, 17.0])
STRAIGHT = np.eye(3)
TURNS = [
    STRAIGHT[:, list(order)] * signs
    for order in itertools.permutations(range(3))
    for signs in ((1, 1, 1), (-1, -1, 1), (1, -1, 1), (-1, -1, -1))
]  # half of them mirrored
OBLIQUE = trimesh.transformations.euler_matrix(0.3, -0.2, 0.5)[:3, :3]


def part(points: np.ndarray) -> np.ndarray:
    """Return the distances of points (..., 3) from the part."""
    large = np.linalg.norm(points - CENTRE, axis=-1) - 2.6
    small = np.linalg.norm(points - CENTRE - [1.9, 0.9, 1.3], axis=-1) - 1.1
    return np.minimum(large, small)


def affine_of(direction: ArrayLike = STRAIGHT, steps: ArrayLike = STEPS) -> np.ndarray:
    """Return the affine (4, 4) of a grid around the part with SIZES."""
    affine = np.eye(4)
    affine[:3, :3] = direction * np.broadcast_to(steps, 3)
    affine[:3, 3] = CENTRE + 0.1 - affine[:3, :3] @ (np.array(SIZES) / 2)
    return affine


AFFINE, CUBES = affine_of(), affine_of(steps=0.5)
FIRST = AFFINE[:3, 3]  # where sample (0, 0, 0) is


def sampled(affine: np.ndarray = AFFINE) -> np.ndarray:
    """Return the samples (ni, nj, nk) of the part at the positions that an affine gives."""
    ijk = np.moveaxis(np.indices(SIZES), 0, -1)
    return part(ijk @ affine[:3, :3].T + affine[:3, 3]).astype(np.float32)


def check(
    grid: SdfGrid, steps: ArrayLike = STEPS, tolerance: float = 2e-5, shift: ArrayLike = 0.0
) -> None:
    """Check that each sample of the grid is the distance at its place in the world.

    If a file states no place, ``shift`` is where its first sample would have to be.
    """
    assert np.allclose(grid.spacing, steps, rtol=1e-5)
    assert sorted(grid.shape) == sorted(SIZES)
    places = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1)) + shift
    assert np.abs(grid.values - part(places)).max() < tolerance
    assert np.array_equal(grid.planes(3, 5), grid.values[3:5])
    assert grid.origin == (0, 0, 0) or not np.any(shift)


def save_nibabel(path: str, affine: np.ndarray) -> None:
    """Write NIfTI in one file or two, or MGH."""
    kinds = {".hdr": nibabel.Nifti1Pair, ".mgz": nibabel.MGHImage}
    kind = kinds.get(Path(path).suffix, nibabel.Nifti1Image)
    nibabel.save(kind(sampled(affine), affine), path)


def save_nrrd(path: str, affine: np.ndarray) -> None:
    """Write NRRD."""
    header = {"space": "left-posterior-superior", "space directions": affine[:3, :3].T}
    nrrd.write(path, sampled(affine), {**header, "space origin": affine[:3, 3]})


def save_itk(path: str, affine: np.ndarray) -> None:
    """Write what ITK writes, which must agree where some samples are."""
    image = sitk.GetImageFromArray(sampled(affine).T)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / spacing).ravel().tolist())
    values = sitk.GetArrayViewFromImage(image).T
    for index in ((0, 0, 0), (5, 3, 11)):
        there = np.array(image.TransformIndexToPhysicalPoint(index))
        assert np.isclose(values[index], part(there), atol=1e-5)
    sitk.WriteImage(image, path, path.endswith(".mha"))


def image_of(affine: np.ndarray, start: ArrayLike = (0, 0, 0)) -> pyvista.ImageData:
    """Return image data of VTK whose extent begins somewhere."""
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    place = {"origin": affine[:3, 3] - affine[:3, :3] @ start, "spacing": steps}
    image = pyvista.ImageData(**place, direction_matrix=affine[:3, :3] / steps)
    image.extent = [n for s, size in zip(start, SIZES) for n in (s, s + size - 1)]
    image["distance"] = part(image.points).astype(np.float32)
    return image


def save_vtk(path: str, affine: np.ndarray) -> None:
    """Write a file of VTK."""
    if path.endswith(".vtkhdf"):
        writer = vtkHDFWriter()
        writer.SetFileName(path)
        writer.SetInputData(image_of(affine))
        assert writer.Write()
    elif path.endswith(".vti"):
        image_of(affine, (3, -2, 7)).save(path)
    else:
        image_of(affine).save(path, binary="text" not in path)


def slices_of(affine: np.ndarray, **about: Any) -> list[pydicom.Dataset]:
    """Return the images of a DICOM series, in the order of their places."""
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    stored = np.rint(sampled(affine) / 0.001).astype(np.int16)
    common = {
        "SeriesInstanceUID": "1.2.3",
        "Rows": SIZES[1],
        "Columns": SIZES[0],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        **{"BitsAllocated": 16, "BitsStored": 16, "HighBit": 15, "PixelRepresentation": 1},
        "PixelSpacing": [steps[1], steps[0]],
        "ImageOrientationPatient": np.round(affine[:3, :2] / steps[:2], 10).T.ravel().tolist(),
        "RescaleSlope": 0.001,
        "RescaleIntercept": 0,
        **about,
    }
    images = []
    for k in range(SIZES[2]):
        images.append(holding(**common, PixelData=stored[:, :, k].T.tobytes()))
        place = affine[:3, 3] + affine[:3, 2] * k
        images[-1].ImagePositionPatient = np.round(place, 8).tolist()
    return images


def holding(dataset: pydicom.Dataset | None = None, **values: Any) -> pydicom.Dataset:
    """Return a dataset with these values; a dataset among them is a sequence of one."""
    dataset = pydicom.Dataset() if dataset is None else dataset
    for name, value in values.items():
        setattr(dataset, name, [value] if isinstance(value, pydicom.Dataset) else value)
    return dataset


def save_slices(path: str, images: list[pydicom.Dataset], start: str = "IM") -> None:
    """Write images to a folder, in names that are not in their order."""
    os.makedirs(path, exist_ok=True)
    for number, image in enumerate(images):
        image.SOPClassUID = CTImageStorage
        image.SOPInstanceUID = generate_uid(entropy_srcs=[start, str(number)])
        write_image(f"{path}/{start}{number * 7 % 31:03d}", image)


def write_image(path: str, image: pydicom.Dataset) -> None:
    """Write an image, behind what a file begins with."""
    image.file_meta = pydicom.dataset.FileMetaDataset()
    image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID
    image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID
    pydicom.dcmwrite(path, image, enforce_file_format=True)


def save_dicom(path: str, affine: np.ndarray) -> None:
    """Write a folder of DICOM slices."""
    save_slices(path, slices_of(affine))


# The formats that state a place, by names of files.
PLACED = {
    **dict.fromkeys(("a.nii", "a.nii.gz", "a.mgz", "a.hdr"), save_nibabel),
    **dict.fromkeys(("a.nrrd", "a.nhdr"), save_nrrd),
    **dict.fromkeys(("b.nrrd", "a.mha", "a.mhd", "itk.h5"), save_itk),
    **dict.fromkeys(("a.vti", "a.vtkhdf"), save_vtk),
    "series": save_dicom,
}


def save_mrc(
    path: str, affine: np.ndarray, order: Any = (2, 1, 0), by_origin: bool = True, first: Any = None
) -> None:
    """Write an MRC file whose sections, rows and columns are along some axes."""
    with mrcfile.new("plain.mrc", overwrite=True) as file:
        file.set_data(np.ascontiguousarray(sampled(affine).transpose(order)))
        header = file.header
        header.maps, header.mapr, header.mapc = (axis + 1 for axis in order)
        header.mx, header.my, header.mz = SIZES
        header.cella = tuple((STEPS * SIZES).tolist())
        if by_origin:
            header.origin = tuple(affine[:3, 3].tolist())
        else:
            header.nzstart, header.nystart, header.nxstart = first[list(order)].tolist()
    data = Path("plain.mrc").read_bytes()
    Path(path).write_bytes(gzip.compress(data) if path.endswith(".gz") else data)


def array_of(order: str = "zyx", falling: str = "") -> xr.DataArray:
    """Return the part as an array of xarray, axes in an order, some of them falling."""
    places = {name: FIRST[a] + STEPS[a] * np.arange(SIZES[a]) for a, name in enumerate("xyz")}
    array = xr.DataArray(sampled(), places, list("xyz"), name="distance")
    turned = array.isel({name: slice(None, None, -1) for name in falling})
    return turned.transpose(*order)


def save_mat(name: str, **variables: Any) -> None:
    """Write variables of MATLAB in version 7.3 if the name says so, else 5."""
    Path(name).unlink(missing_ok=True)
    if "73" in name:
        hdf5storage.savemat(name, variables, format="7.3")
    else:
        scipy.io.savemat(name, variables, do_compression="packed" in name)


def text_sdf(affine: np.ndarray = CUBES) -> str:
    """Return the text that SDFGen's main.cpp writes: endl after each value, i fastest."""
    origin = " ".join(map(str, affine[:3, 3]))
    head = "{} {} {}\n".format(*SIZES) + f"{origin}\n{affine[0, 0]}\n"
    return head + "".join(f"{value:.6g}\n" for value in sampled(affine).ravel("F"))


def save(name: str, affine: np.ndarray = AFFINE) -> None:
    """Write the part in the format of the name."""
    suffix = Path(name.removesuffix(".gz")).suffix
    if suffix == ".h5" and name not in PLACED:
        with h5py.File(name, "w") as file:
            file["field"] = sampled(affine).T
    elif suffix == ".tif":
        tifffile.imwrite(name, sampled(affine).T, photometric="minisblack")
    elif suffix == ".vdb":
        Path(name).write_bytes((DATA / "two-balls.vdb").read_bytes())
    elif suffix == ".sdf":
        Path(name).write_text(text_sdf())
    elif suffix == ".nc":
        version = "NETCDF3_CLASSIC" if "3" in name else "NETCDF4"
        array_of().to_netcdf(name, engine="netcdf4", format=version)
    elif suffix == ".mat":
        save_mat(name, d=sampled(affine))
    else:
        others = {".mrc": save_mrc, ".map": save_mrc, ".vtk": save_vtk}
        (PLACED.get(name) or others[suffix])(name, affine)
