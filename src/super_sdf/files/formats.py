"""The table of grid file formats: help texts, messages, extras and readers follow it.

A new format is a row here, and its reader in ``readers``.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from typing import NamedTuple

from ..errors import OptionError, check_modules
from ..options import MESH_FORMATS, OPTIONS

# What people give by mistake: surfaces, which have to be sampled first.
SURFACES = (*(f".{name}" for name in MESH_FORMATS), ".gltf")
# What is no grid file here, and the way out: {0} is the file, {1} its name without the suffix.
CAD = "is a CAD model: export it as {1}.stl, then super-sdf sample {1}.stl {1}.npz -n 64"
WAYS_OUT = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), CAD),
    ".nvdb": "is NanoVDB: make OpenVDB of it with OpenVDB's tool nanovdb_convert {0} {1}.vdb",
    ".dcm": "is a DICOM image: give the folder that holds its series",
    ".img": "holds the samples of an Analyze file: give its header {1}.hdr",
}


class GridFormat(NamedTuple):
    """A grid file format."""

    key: str  # of its reader: ``read_key`` in ``readers.module``
    name: str  # in texts
    suffixes: tuple[str, ...]  # how its file names end, in lower case
    module: str  # in ``readers``
    extra: str | None = None  # that installs its library
    axes: str | None = None  # the order of axes without --axes; None if the file states it
    has_members: bool = False  # whether a file may hold several arrays: FILE:NAME


MRC_SUFFIXES = (".mrc", ".map", ".ccp4", ".mrc.gz", ".map.gz", ".ccp4.gz")
FORMATS = (
    GridFormat("npy", "NumPy", (".npy",), "numpy", axes="xyz"),
    GridFormat("npz", "NumPy", (".npz",), "numpy", axes="xyz"),
    GridFormat("nifti", "NIfTI", (".nii", ".nii.gz"), "nibabel", "nifti"),
    GridFormat("nrrd", "NRRD", (".nrrd", ".nhdr"), "nrrd", "nrrd"),
    GridFormat("metaimage", "MetaImage", (".mha", ".mhd"), "simpleitk", "metaimage"),
    GridFormat("vti", "VTK image data", (".vti",), "vtk", "vti", has_members=True),
    GridFormat("tiff", "TIFF stack", (".tif", ".tiff"), "tifffile", "tiff", "zyx"),
    GridFormat("hdf5", "HDF5", (".h5", ".hdf5", ".hdf"), "h5py", "hdf5", "zyx", True),
    GridFormat("zarr", "Zarr", (".zarr", ".zarr.zip"), "zarr", "zarr", "zyx", True),
    GridFormat("vdb", "OpenVDB", (".vdb",), "vdb", "vdb", has_members=True),
    GridFormat("sdf", "SDFGen", (".sdf",), "sdf"),
    GridFormat("mgh", "FreeSurfer", (".mgz", ".mgh"), "nibabel", "nifti"),
    GridFormat("analyze", "Analyze", (".hdr",), "nibabel", "nifti"),
    GridFormat("mrc", "MRC", MRC_SUFFIXES, "mrcfile", "mrc"),
    GridFormat("vtk", "legacy VTK", (".vtk",), "vtk", "vti", has_members=True),
    GridFormat("vtkhdf", "VTKHDF", (".vtkhdf",), "vtk", "vti", has_members=True),
    GridFormat("netcdf", "NetCDF", (".nc", ".nc4", ".cdf"), "scipy", "netcdf", "zyx", True),
    GridFormat("mat", "MATLAB", (".mat",), "scipy", "mat", "xyz", True),
)
DICOM = GridFormat("dicom", "DICOM", ("a folder",), "pydicom", "dicom", has_members=True)
"""A folder that is no Zarr store: the names of slices end in anything."""

GRID_SUFFIXES = tuple(suffix for format_ in FORMATS for suffix in format_.suffixes)
_MEMBERS = "|".join(re.escape(s[1:]) for f in FORMATS if f.has_members for s in f.suffixes)
_WITH_MEMBER = re.compile(rf"(?P<file>.*\.(?:{_MEMBERS})):(?P<member>.+)", re.I | re.S)


def find_format(path: str | Path) -> GridFormat:
    """Return the format of a grid file by its name; raise OptionError if it is none, or a mesh."""
    file, _ = split_member(path)
    ending = _ending(file)
    if ending:
        return next(format_ for format_ in FORMATS if ending in format_.suffixes)
    if file.is_dir():
        return DICOM
    if file.suffix.lower() in WAYS_OUT:
        raise OptionError(f"{path} {WAYS_OUT[file.suffix.lower()].format(file, file.stem)}")
    if str(path).lower().endswith(SURFACES):
        raise OptionError(
            f"{path} is a mesh, not a grid: sample it first with "
            f"super-sdf sample {path} {PurePath(path).stem}.npz -n 64"
        )
    raise OptionError(f"{path} is not a grid file: give one of {', '.join(GRID_SUFFIXES)}")


def is_grid(path: str | Path) -> bool:
    """Return whether a name is that of a grid file, by its end, or a folder."""
    file, _ = split_member(path)
    return bool(_ending(file)) or file.is_dir()


def _ending(path: PurePath) -> str:
    name = path.name.lower()
    ends = [end for end in GRID_SUFFIXES if name.endswith(end) and len(name) > len(end)]
    return max(ends, key=len, default="")


def split_member(path: str | PurePath) -> tuple[Path, str | None]:
    """Split ``FILE:NAME`` into the file and the name of an array in it, None if none is named."""
    parts = _WITH_MEMBER.fullmatch(str(path))
    if parts:
        return Path(parts["file"]), parts["member"]
    folder, _, series = str(path).rpartition(":")
    if folder and Path(folder).is_dir() and not Path(path).exists():
        return Path(folder), series
    return Path(path), None


def mesh_path(path: PurePath, suffix: str, label: int | None = None) -> PurePath:
    """Return the path of a grid with the suffix of a mesh.

    The name of an array in the file becomes a part of it, and the label whose mesh it is:
    ``a.h5:/b/c`` becomes ``a-b-c.ply``, and with the label 3 ``a-b-c-label3.ply``.
    """
    file, member = split_member(path)
    ending = _ending(file) or file.suffix
    stem = file.name[: len(file.name) - len(ending)]
    if member:
        stem += "-" + member.strip("/").replace("/", "-")
    if label is not None:
        stem += f"-label{label}"
    return PurePath(file).with_name(stem + suffix)


def check_library(format_: GridFormat) -> None:
    """Raise FileError, naming the extra to install, if the format's library is missing."""
    if format_.extra:
        check_modules(f"{format_.name} ({format_.suffixes[0]})", format_.extra)


def choose_axes(format_: GridFormat, given: str | None, direction: object = None) -> str:
    """Return the axis order of an array file: as given, else the convention of the format.

    Raises OptionError if it, or a direction, is given, but files of the format state it.
    """
    if given is not None:
        OPTIONS["axes"].check(given)
    if format_.axes is None and (given is not None or direction is not None):
        what = f"axes is {given!r}" if given is not None else "direction is given"
        raise OptionError(f"{what}, but {format_.name} files state their axes: leave it out")
    return given or format_.axes or "xyz"


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


def list_formats() -> str:
    """Return the formats and their suffixes for help texts, in one sentence."""
    suffixes: dict[str, tuple[str, ...]] = {}
    for format_ in (*FORMATS, DICOM):
        suffixes[format_.name] = (*suffixes.get(format_.name, ()), *format_.suffixes)
    return _listed([f"{name} ({', '.join(suffixes[name])})" for name in suffixes])


NAMED = _listed([format_.name for format_ in (*FORMATS, DICOM) if format_.has_members])
"""The formats whose files may hold several arrays, for help texts."""
