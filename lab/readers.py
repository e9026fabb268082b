"""Every reader against a second library's reading of the same file: a table for docs/formats.md.

    python -m lab readers
    python -m lab readers --only .nrrd .mrc

A small volume of its own for each format is written by a library that is common for it: three
unequal spacings, off the origin, without a symmetry, turned where the format states a direction.
``read_grid`` and another library read the file. Compared are where samples are in the world, the
steps between them, the side (whether the axes are right-handed there) and all values. Needs the
extra ``test``. Exit code 1 if anything differs.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from super_sdf import read_grid

SIZES = (13, 11, 9)
STEPS = np.array([0.5, 0.75, 1.25])
CORNER = np.array([40.0, -30.0, 12.5])  # multiples of the steps, as MRC's nstart wants
AXES = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
ANGLES = 0.3, -0.2, 0.5
PLACE, VALUE = 1e-4, 1e-5  # shares of a step and of the largest value by which readings may differ
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])  # between LPS and RAS
ASPECTS = "place", "size", "side", "values"
Reading = tuple[np.ndarray, np.ndarray]  # values (i, j, k), and the affine (4, 4) to the world


def rotation() -> np.ndarray:
    """Return an oblique rotation."""
    turned = np.eye(3)
    for axis, angle in enumerate(ANGLES):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[a, a, b, b], [a, b, a, b]] = (
            np.cos(angle),
            -np.sin(angle),
            np.sin(angle),
            np.cos(angle),
        )
        turned = turned @ turn
    return turned


def affine_of(direction: np.ndarray, steps: Any = STEPS, corner: Any = CORNER) -> np.ndarray:
    """Return the affine (4, 4) of a grid."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = np.asarray(direction) * steps, corner
    return affine


STRAIGHT, TURNED = affine_of(np.eye(3)), affine_of(rotation() @ AXES)


def sampled(affine: np.ndarray) -> np.ndarray:
    """Return the distances (i, j, k) to a ball with a smaller one beside it, float32."""
    places = np.moveaxis(np.indices(SIZES), 0, -1) @ affine[:3, :3].T
    middle = affine[:3, :3] @ (np.array(SIZES) / 2 - 0.4)
    large = np.linalg.norm(places - middle, axis=-1) - 2.1
    small = np.linalg.norm(places - middle - [1.2, 0.7, 1.6], axis=-1) - 1.1
    return np.minimum(large, small).astype(np.float32)


def coordinates(affine: np.ndarray) -> list[np.ndarray]:
    """Return the coordinates along x, y and z of a straight grid."""
    return [affine[a, 3] + affine[a, a] * np.arange(n) for a, n in enumerate(SIZES)]


# What libraries write.


def write_nibabel(path: Path, affine: np.ndarray) -> None:
    """Write the format that the name says."""
    import nibabel

    kinds = {".mgz": nibabel.MGHImage, ".hdr": nibabel.AnalyzeImage}
    kind = kinds.get(path.suffix, nibabel.Nifti1Image)
    nibabel.save(
        kind(sampled(affine), np.diag([*STEPS, 1]) if path.suffix == ".hdr" else affine), path
    )


def write_second_nifti(path: Path, affine: np.ndarray) -> None:
    """Write NIfTI-2."""
    import nibabel

    nibabel.save(nibabel.Nifti2Image(sampled(affine), affine), path)


def write_unplaced_nifti(path: Path, affine: np.ndarray) -> None:
    """Write NIfTI whose sform and qform have code 0."""
    import nibabel

    image = nibabel.Nifti1Image(sampled(affine), None)
    image.header.set_zooms(STEPS)
    image.set_sform(None, 0)
    image.set_qform(None, 0)
    nibabel.save(image, path)


def write_spaced_nrrd(path: Path, affine: np.ndarray) -> None:
    """Write NRRD without a space, or with a leading list axis of length 1."""
    import nrrd

    if "list" in path.name:
        steps = np.vstack([[np.nan] * 3, affine[:3, :3].T])
        about = {"space": "left-posterior-superior", "space directions": steps}
        about |= {"kinds": ["list"] + ["domain"] * 3, "space origin": affine[:3, 3]}
        nrrd.write(str(path), sampled(affine)[None], about)
    else:
        nrrd.write(str(path), sampled(affine), {"spacings": STEPS, "axis mins": CORNER})


def write_cells(path: Path, affine: np.ndarray) -> None:
    """Write image data of cells, whose centres are the samples."""
    import pyvista

    steps = np.linalg.norm(affine[:3, :3], axis=0)
    corner = affine[:3, 3] - affine[:3, :3].sum(1) / 2
    place = {"origin": corner, "direction_matrix": affine[:3, :3] / steps}
    image = pyvista.ImageData(dimensions=np.add(SIZES, 1), spacing=steps, **place)
    image.cell_data["distance"] = sampled(affine).ravel("F")
    image.save(path)


def write_nrrd(path: Path, affine: np.ndarray) -> None:
    """Write NRRD in LPS."""
    import nrrd

    place = {"space directions": affine[:3, :3].T, "space origin": affine[:3, 3]}
    nrrd.write(str(path), sampled(affine), {"space": "left-posterior-superior", **place})


def write_itk(path: Path, affine: np.ndarray) -> None:
    """Write a file in LPS."""
    import SimpleITK as sitk  # noqa: N813

    image = sitk.GetImageFromArray(sampled(affine).T)
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    image.SetSpacing(steps.tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / steps).ravel().tolist())
    sitk.WriteImage(image, str(path), path.suffix == ".mha")


def vtk_image(affine: np.ndarray) -> Any:
    """Return VTK image data."""
    import pyvista

    steps = np.linalg.norm(affine[:3, :3], axis=0)
    place = {"origin": affine[:3, 3], "direction_matrix": affine[:3, :3] / steps}
    image = pyvista.ImageData(dimensions=SIZES, spacing=steps, **place)
    image["distance"] = sampled(affine).ravel("F")
    return image


def write_vtk(path: Path, affine: np.ndarray) -> None:
    """Write image data, as text if the name says so."""
    vtk_image(affine).save(path, binary="text" not in path.name)


def write_vtkhdf(path: Path, affine: np.ndarray) -> None:
    """Write VTK's dialect of HDF5."""
    from vtkmodules.vtkIOHDF import vtkHDFWriter

    writer = vtkHDFWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(vtk_image(affine))
    writer.Write()


def write_mrc(path: Path, affine: np.ndarray) -> None:
    """Write its place as the origin; in ``.map`` as nstart, with sections along x."""
    import mrcfile

    order = (0, 2, 1) if path.suffix == ".map" else (2, 1, 0)  # sections, rows, columns
    with mrcfile.new(path) as file:
        file.set_data(np.ascontiguousarray(sampled(affine).transpose(order)))
        header = file.header
        header.maps, header.mapr, header.mapc = (axis + 1 for axis in order)
        header.mx, header.my, header.mz = SIZES
        header.cella = tuple((STEPS * SIZES).tolist())
        if path.suffix == ".map":
            first = np.rint(CORNER / STEPS).astype(int)[list(order)].tolist()
            header.nzstart, header.nystart, header.nxstart = first
        else:
            header.origin = tuple(CORNER.tolist())


def write_xarray(path: Path, affine: np.ndarray) -> None:
    """Write an array (z, x, y) with falling y."""
    import xarray

    about = dict(zip("xyz", coordinates(affine)))
    array = xarray.DataArray(sampled(affine), about, list("xyz"), "distance")
    data = array.isel(y=slice(None, None, -1)).transpose("z", "x", "y").to_dataset()
    if path.suffix == ".zarr":
        data.to_zarr(path)
    else:
        old = "3" in path.name
        form: Any = {"format": "NETCDF3_64BIT" if old else "NETCDF4", "engine": "netcdf4"}
        data.to_netcdf(path, **form)


def write_tiff(path: Path, affine: np.ndarray) -> None:
    """Write the metadata of ImageJ, or OME's."""
    import tifffile

    x, y, z = STEPS
    data = sampled(affine).T
    if ".ome." in path.name:
        sizes = {"PhysicalSizeX": x, "PhysicalSizeY": y, "PhysicalSizeZ": z}
        tifffile.imwrite(path, data, metadata={"axes": "ZYX", **sizes})
    else:
        about = {"axes": "ZYX", "spacing": z, "unit": "mm"}
        tifffile.imwrite(path, data, imagej=True, resolution=(1 / x, 1 / y), metadata=about)


def write_mat(path: Path, affine: np.ndarray) -> None:
    """Write version 5, packed, or 7.3."""
    import hdf5storage
    import scipy.io

    data = {"distance": sampled(affine)}
    if "73" in path.name:
        hdf5storage.savemat(str(path), data, format="7.3")
    else:
        scipy.io.savemat(path, data, do_compression=True)


def write_dicom(path: Path, affine: np.ndarray) -> None:
    """Write a slice a file, in names of another order, with slope and intercept."""
    import pydicom
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    path.mkdir()
    steps = np.linalg.norm(affine[:3, :3], axis=0)
    across = np.round(affine[:3, :2] / steps[:2], 10).T.ravel().tolist()
    stored = np.rint((sampled(affine) + 5) / 0.001).astype(np.int16)
    series = generate_uid()
    for k in range(SIZES[2]):
        image = pydicom.Dataset()
        image.file_meta = pydicom.dataset.FileMetaDataset()
        image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = CTImageStorage
        image.SOPInstanceUID = generate_uid()
        image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID
        image.SeriesInstanceUID = image.StudyInstanceUID = series
        image.Modality, image.PatientID, image.InstanceNumber = "CT", "ball", k + 1
        image.Columns, image.Rows, _ = SIZES
        image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
        image.BitsAllocated, image.BitsStored, image.HighBit = 16, 16, 15
        image.PixelRepresentation = 1
        image.PixelSpacing, image.SliceThickness = [steps[1], steps[0]], steps[2]
        image.ImageOrientationPatient = across
        place = affine[:3, 3] + affine[:3, 2] * k
        image.ImagePositionPatient = np.round(place, 8).tolist()
        image.RescaleSlope, image.RescaleIntercept = 0.001, -5
        image.PixelData = stored[:, :, k].T.tobytes()
        image.save_as(path / f"IM{k * 7 % 10}", enforce_file_format=True)


# What second libraries read.


def read_itk(path: Path) -> Reading:
    """Return a file or a series in LPS."""
    import SimpleITK as sitk  # noqa: N813

    names: Any = str(path)
    if path.is_dir():
        names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(names)
    image = sitk.ReadImage(names)
    while image.GetDimension() > 3:
        image = image[..., 0]
    direction = np.array(image.GetDirection()).reshape(3, 3)
    affine = affine_of(direction, image.GetSpacing(), image.GetOrigin())
    return sitk.GetArrayFromImage(image).T, affine


def read_itk_ras(path: Path) -> Reading:
    """Return a file in RAS."""
    values, affine = read_itk(path)
    return values, FLIP @ affine


def read_vtk(path: Path) -> Reading:
    """Return image data of points or cells."""
    import pyvista

    image = pyvista.read(path)
    affine = affine_of(np.array(image.direction_matrix), image.spacing, image.origin)
    of_cells = len(image.cell_data)
    affine[:3, 3] = image.cell_centers().points[0] if of_cells else image.points[0]
    sizes = tuple(np.array(image.dimensions) - of_cells)
    return np.asarray(image["distance"]).reshape(sizes, order="F"), affine


def read_nibabel(path: Path) -> Reading:
    """Return what nibabel makes of a file."""
    import nibabel

    image = nibabel.load(path)
    return np.asarray(image.dataobj), image.affine.copy()


def read_h5py_vtk(path: Path) -> Reading:
    """Return the image in VTK's dialect of HDF5."""
    import h5py

    with h5py.File(path) as file:
        image = file["VTKHDF"]
        place = (image.attrs[name] for name in ("Direction", "Spacing", "Origin"))
        direction, steps, corner = place
        values = image["PointData/distance"][:].T
    return values, affine_of(np.reshape(direction, (3, 3)), steps, corner)


def read_gemmi(path: Path) -> Reading:
    """Return a map with its axes in the order x, y, z."""
    import gemmi

    file = gemmi.read_ccp4_map(str(path))
    order = list(file.axis_positions())  # where x, y and z are among columns, rows and sections
    first = np.array([file.header_i32(word) for word in (5, 6, 7)])[order]
    counts = np.array([file.header_i32(word) for word in (8, 9, 10)])
    steps = np.array(file.grid.unit_cell.parameters[:3]) / counts
    values = np.array(file.grid.array).transpose(order)
    return values, affine_of(np.eye(3), steps, first * steps)


def from_named(values: Any, places: dict[str, np.ndarray], names: tuple[str, ...]) -> Reading:
    """Return an array whose axes have names and coordinates."""
    direction, corner = np.zeros((3, 3)), np.zeros(3)
    for axis, name in enumerate(names):
        world = "xyz".index(name)
        direction[world, axis] = places[name][1] - places[name][0]
        corner[world] = places[name][0]
    return np.asarray(values), affine_of(direction, 1, corner)


def read_scipy_netcdf(path: Path) -> Reading:
    """Return a variable of version 3."""
    import scipy.io

    with scipy.io.netcdf_file(path, mmap=False) as file:
        places = {name: file.variables[name][:] for name in "xyz"}
        values = file.variables["distance"]
        return from_named(values[:].copy(), places, values.dimensions)


def read_h5py_scales(path: Path) -> Reading:
    """Return a dataset with dimension scales."""
    import h5py

    with h5py.File(path) as file:
        values = file["distance"]
        scales = [dimension[0] for dimension in values.dims]
        names = tuple(scale.name.strip("/") for scale in scales)
        return from_named(values[:], dict(zip(names, (s[:] for s in scales))), names)


def read_xarray(path: Path) -> Reading:
    """Return an array of NetCDF, HDF5 or Zarr."""
    import xarray

    opened = xarray.open_zarr(path) if path.suffix == ".zarr" else xarray.open_dataset(path)
    with opened as data:
        array = data["distance"]
        places = {name: array[name].values for name in "xyz"}
        return from_named(array.values, places, tuple(map(str, array.dims)))


def read_pymatio(path: Path) -> Reading:
    """Return an array by libmatio."""
    import pymatio

    return np.asarray(pymatio.loadmat(str(path))["distance"]), STRAIGHT


def read_hdf5storage(path: Path) -> Reading:
    """Return an array of version 7.3."""
    import hdf5storage

    return hdf5storage.loadmat(str(path))["distance"], STRAIGHT


def read_analyze(path: Path) -> Reading:
    """Return a file at the place that is given."""
    values, affine = read_itk(path)
    affine[:3, 3] = CORNER  # it states none
    return values, affine


def read_tiff(path: Path) -> Reading:
    """Return the pages, whose place is given."""
    return read_itk(path)[0], STRAIGHT


@dataclass(frozen=True)
class Row:
    """A file, the library that writes it, and the one that reads it beside ``read_grid``.

    ``given`` is what ``read_grid`` is given of the place, ``compared`` what both libraries state.
    """

    name: str
    writer: str
    reader: str
    write: Callable[[Path, np.ndarray], None]
    read: Callable[[Path], Reading]
    affine: np.ndarray = field(default_factory=lambda: TURNED)
    given: dict[str, Any] = field(default_factory=dict)
    compared: tuple[str, ...] = ASPECTS


ITK, PYDICOM, XARRAY, MRCFILE = "SimpleITK", "pydicom", "xarray", "mrcfile"
FROM, PLACED, ORDER = {"origin": CORNER}, {"origin": CORNER, "spacing": STEPS}, ASPECTS[2:]
ROWS = [
    Row("turned.nii", "nibabel", ITK, write_nibabel, read_itk_ras),
    Row("turned.nii.gz", "nibabel", ITK, write_nibabel, read_itk_ras),
    Row("second-turned.nii", "nibabel", "nibabel", write_second_nifti, read_nibabel),
    Row(
        "codes-0.nii",
        "nibabel",
        ITK,
        write_unplaced_nifti,
        read_analyze,
        STRAIGHT,
        FROM,
        ASPECTS[1:],
    ),
    Row("turned.nrrd", "pynrrd", ITK, write_nrrd, read_itk),
    Row("turned.nhdr", "pynrrd", ITK, write_nrrd, read_itk),
    Row("mins.nrrd", "pynrrd", ITK, write_spaced_nrrd, read_itk, STRAIGHT),
    Row("list-turned.nrrd", "pynrrd", ITK, write_spaced_nrrd, read_itk),
    Row("turned-itk.nrrd", ITK, ITK, write_itk, read_itk),
    Row("turned.mha", ITK, ITK, write_itk, read_itk),
    Row("turned.mhd", ITK, ITK, write_itk, read_itk),
    Row("turned.vti", "VTK", "VTK", write_vtk, read_vtk),
    Row("cells-turned.vti", "VTK", "VTK", write_cells, read_vtk),
    Row("imagej.tif", "tifffile", ITK, write_tiff, read_tiff, STRAIGHT, FROM, ORDER),
    Row("stack.ome.tif", "tifffile", ITK, write_tiff, read_tiff, STRAIGHT, FROM, ORDER),
    Row("turned-itk.h5", ITK, ITK, write_itk, read_itk),
    Row("scales.h5", XARRAY, XARRAY, write_xarray, read_xarray, STRAIGHT),
    Row("coordinates.zarr", XARRAY, XARRAY, write_xarray, read_xarray, STRAIGHT),
    Row("analyze.hdr", "nibabel", ITK, write_nibabel, read_analyze, STRAIGHT, FROM, ASPECTS[1:]),
    Row("volume.mrc", MRCFILE, ITK, write_mrc, read_itk, STRAIGHT),
    Row("axes.map", MRCFILE, "gemmi", write_mrc, read_gemmi, STRAIGHT),
    Row("legacy.vtk", "VTK", ITK, write_vtk, read_itk, STRAIGHT),
    Row("text.vtk", "VTK", ITK, write_vtk, read_itk, STRAIGHT),
    Row("turned.vtkhdf", "VTK", "h5py", write_vtkhdf, read_h5py_vtk),
    Row("version4.nc", XARRAY, "h5py", write_xarray, read_h5py_scales, STRAIGHT),
    Row("version3.nc", XARRAY, "SciPy", write_xarray, read_scipy_netcdf, STRAIGHT),
    Row("version5.mat", "SciPy", "pymatio", write_mat, read_pymatio, STRAIGHT, PLACED, ORDER),
    Row(
        "version73.mat",
        "hdf5storage",
        "hdf5storage",
        write_mat,
        read_hdf5storage,
        STRAIGHT,
        PLACED,
        ORDER,
    ),
    Row("turned-dicom", PYDICOM, ITK, write_dicom, read_itk),
]


def compare(path: Path, row: Row) -> dict[str, bool]:
    """Return whether both readings of a file agree, by aspect."""
    values, affine = row.read(path)
    grid = read_grid(path, **row.given)
    ours = affine_of(grid.direction, grid.spacing, grid.origin)
    turn = np.rint(np.linalg.inv(ours[:3, :3]) @ affine[:3, :3])  # from the file's axes to ours
    steps = np.linalg.norm(ours[:3, :3] @ np.abs(turn), axis=0)
    places = np.moveaxis(np.indices(values.shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    there = grid.to_index(places.reshape(-1, 3)).reshape(places.shape)
    index = np.clip(np.rint(there), 0, np.array(grid.shape) - 1).astype(int)
    found = grid.values[tuple(np.moveaxis(index, -1, 0))]
    handed = np.linalg.det(turn) * np.linalg.det(affine[:3, :3]) * np.linalg.det(ours[:3, :3])
    return {
        "place": bool(np.abs(there - index).max() < PLACE),
        "size": bool(np.allclose(steps, np.linalg.norm(affine[:3, :3], axis=0), rtol=PLACE)),
        "side": bool(handed > 0),
        "values": bool(np.abs(found - values).max() <= VALUE * np.abs(values).max()),
    }


def cells(row: Row, folder: Path) -> list[str]:
    """Write a file; return what stands in its row of the table."""
    path = folder / row.name
    row.write(path, row.affine)
    agree = compare(path, row)
    said = ["-" if a not in row.compared else "same" if agree[a] else "DIFFERS" for a in ASPECTS]
    turned = "turned" if row.affine is TURNED else "straight"
    return [f"`{row.name}`", turned, row.writer, row.reader, *said]


def main() -> None:
    """Print the table; exit code 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--only", nargs="+", default=[""], help="rows whose names have one of these"
    )
    only = parser.parse_args().only
    warnings.simplefilter("ignore")  # libraries on their own formats
    print("| File | Axes | Written by | Compared with | Place | Size | Side | Values |")
    print(f"|{' --- |' * 8}")
    differ = 0
    for row in (row for row in ROWS if any(word in row.name for word in only)):
        with tempfile.TemporaryDirectory() as folder:
            found = cells(row, Path(folder))
        print(f"| {' | '.join(found)} |", flush=True)
        differ += "DIFFERS" in found
    raise SystemExit(int(differ > 0))
