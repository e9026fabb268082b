"""Grid files by their names: the table of formats, and which files are read for a grid.

A new format is a row of the table, and its reader in ``readers``. Files with other endings may be
those of another package (docs/guides/formats.md). Only regular files are read: opening a named pipe
may wait forever. Some files name others, which must lie beside them.
"""

from __future__ import annotations

import os
import re
import stat
from functools import cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..errors import FileError, OptionError, seen
from ..options import MESH_FORMATS

# What people give by mistake: surfaces, which have to be sampled first, and others.
SURFACES = (*(f".{name}" for name in MESH_FORMATS), ".gltf")
CAD = (".step", ".stp", ".iges", ".igs")


class GridFormat(NamedTuple):
    """A grid file format."""

    key: str  # of its reader: ``read_key`` in ``readers.module``
    name: str  # in texts
    suffixes: tuple[str, ...]  # how its file names end, in lower case
    module: str  # in ``readers``
    extra: str | None = None  # that installs its library
    axes: str | None = None  # the order of axes without --axes; None if the file states it
    has_members: bool = False  # whether a file may hold several arrays: FILE:NAME


MRC = (".mrc", ".map", ".ccp4", ".rec", ".mrc.gz", ".map.gz", ".ccp4.gz")
FORMATS = (
    GridFormat("npy", "NumPy", (".npy",), "numpy", axes="xyz"),
    GridFormat("npz", "NumPy", (".npz",), "numpy", axes="xyz", has_members=True),
    GridFormat("nifti", "NIfTI", (".nii", ".nii.gz"), "headers", "nifti"),
    GridFormat("nrrd", "NRRD", (".nrrd", ".nhdr"), "headers", "nrrd"),
    GridFormat("metaimage", "MetaImage", (".mha", ".mhd"), "headers", "metaimage"),
    GridFormat("vtk", "VTK image data", (".vti",), "vtk", "vti", has_members=True),
    GridFormat("tiff", "TIFF stack", (".tif", ".tiff"), "tifffile", "tiff", "zyx"),
    GridFormat("hdf5", "HDF5", (".h5", ".hdf5", ".hdf", ".ims"), "h5py", "hdf5", "zyx", True),
    GridFormat("zarr", "Zarr", (".zarr", ".zarr.zip"), "zarr", "zarr", "zyx", True),
    GridFormat("vdb", "OpenVDB", (".vdb",), "vdb", "vdb", has_members=True),
    GridFormat("sdf", "SDFGen", (".sdf",), "numpy"),
    GridFormat("mgh", "FreeSurfer", (".mgz", ".mgh"), "headers", "nifti"),
    GridFormat("analyze", "Analyze", (".hdr",), "headers", "nifti"),
    GridFormat("mrc", "MRC", MRC, "headers", "mrc"),
    GridFormat("vtk", "legacy VTK", (".vtk",), "vtk", "vti", has_members=True),
    GridFormat("vtk", "VTKHDF", (".vtkhdf",), "vtk", "vti", has_members=True),
    GridFormat("netcdf", "NetCDF", (".nc", ".nc4", ".cdf"), "h5py", "netcdf", "zyx", True),
    GridFormat("mat", "MATLAB", (".mat",), "h5py", "mat", "xyz", True),
    GridFormat("dicom", "DICOM", (".dcm",), "pydicom", "dicom", has_members=True),
)
DICOM = FORMATS[-1]._replace(suffixes=("a folder",))
"""A folder that is no Zarr store: the names of slices end in anything."""

LISTED = ", ".join(f"{each.name} ({', '.join(each.suffixes)})" for each in (*FORMATS, DICOM))
NAMED = ", ".join(dict.fromkeys(each.name for each in FORMATS if each.has_members))
"""The formats whose files may hold several arrays, for help texts, as ``LISTED``."""
GRID_SUFFIXES = tuple(suffix for format_ in FORMATS for suffix in format_.suffixes)
_ENDS = "|".join(map(re.escape, sorted(GRID_SUFFIXES, key=len, reverse=True)))
_WITH_MEMBER = re.compile(
    rf"(?P<file>.*?[^/](?:{_ENDS}))(?P<member>(?::[^\[]+|:.+?)?(?:\[\d+\])*)", re.I | re.S
)


def find_format(path: str | Path) -> GridFormat:
    """Return the format of a grid file by its name; raise OptionError if it is none, or a mesh."""
    file, member = split_member(path)
    if ending := _ending(file):
        other = GridFormat("plugin", ending, (ending,), "numpy", axes="xyz")  # another package's
        format_ = next((format_ for format_ in FORMATS if ending in format_.suffixes), other)
        if member and member[0] != "[" and not format_.has_members:
            raise OptionError(f"{format_.name} files hold one array: give --label, not :{member}")
        return format_
    if file.is_dir():
        return DICOM
    if (kind := file.suffix.lower()) in (*SURFACES, *CAD):
        mesh, what = (f"{file.stem}.stl", "CAD model") if kind in CAD else (path, "mesh")
        first = f"export {mesh}, then " * (kind in CAD) + f"super-sdf sample {mesh} {file.stem}.npz"
        raise OptionError(f"{path} is a {what}, not a grid: sample it first, {first} -n 64")
    raise OptionError(f"{path} is not a grid file: give one of {', '.join(GRID_SUFFIXES)}")


def is_grid(path: str | Path) -> bool:
    """Return whether a name is that of a grid file, by its end, or a folder."""
    file, _ = split_member(path)
    return bool(_ending(file)) or file.is_dir()


def _ending(path: PurePath) -> str:
    name, other = path.name.lower(), path.suffix.lower()
    ends = [end for end in GRID_SUFFIXES if name.endswith(end) and len(name) > len(end)]
    return max(ends, key=len) if ends else other if plugin("readers", other) else ""


@cache
def plugin(group: str, ending: str) -> Any:
    """Return the entry point of another package for files with an ending, if there is one."""
    from importlib.metadata import entry_points  # imported here, as few files need it

    return next(iter(entry_points(group=f"super_sdf.{group}", name=ending[1:].lower())), None)


def split_member(path: str | PurePath) -> tuple[Path, str | None]:
    """Split ``FILE:NAME[3]`` into the file and what is named in it, None if nothing is."""
    parts = _WITH_MEMBER.fullmatch(str(path))
    if parts:
        return Path(parts["file"]), parts["member"].removeprefix(":") or None
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
        stem += "-" + re.sub(r"[/\[\]]+", "-", member).strip("-")
    if label is not None:
        stem += f"-label{label}"
    return PurePath(file).with_name(stem + suffix)


# Files

HEADERS = (".mhd", ".mha", ".nhdr", ".nrrd")  # text that may name data files, a line each
LONGEST_HEADER = 1 << 20  # bytes
DATA = re.compile(rb"^[ \t]*(?:ElementDataFile *[=:]|data ?file[ \t]*:=?) *([^\n]*)\n?", re.M)


def check_regular_file(path: str | Path) -> Path:
    """Return the path of a regular file that is not empty, never opened; else raise FileError."""
    try:
        state = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise FileError(f"{path} {reason_of(error)}") from None
    if not stat.S_ISREG(state.st_mode):
        kind = "a folder" if stat.S_ISDIR(state.st_mode) else "no regular file"
        raise FileError(f"{path} is {kind}: give a file")
    if not state.st_size:  # such as files in /proc, which the system makes up as they are read
        raise FileError(f"{path} is empty: give a file with something in it")
    return Path(path)


def reason_of(error: OSError | ValueError) -> str:
    """Return why the system refuses to read a file, as the words after its name."""
    if isinstance(error, (FileNotFoundError, NotADirectoryError)):
        return "does not exist"
    return f"cannot be read: {getattr(error, 'strerror', None) or error}"


def check_beside(path: Path, name: str) -> Path:
    """Return the file that another file, or a folder, names as part of it.

    FileError if it is no regular file, or neither in the folder nor below.
    """
    homes = (path,) if path.is_dir() else (path.parent, path.resolve().parent)  # of links, too
    other = homes[0] / name
    if not any(other.resolve().is_relative_to(home.resolve()) for home in homes):
        said = f"{path} names the file {seen(name)}, which is not in its folder"
        raise FileError(f"{said}: put both into one folder")
    return check_regular_file(other)


def split_header(path: Path) -> tuple[bytes, str, int]:
    """Return a MetaImage or NRRD header before the name of its data file, it, and where it ends."""
    with path.open("rb") as file:
        text = file.read(LONGEST_HEADER)
    if path.suffix.lower() in (".nrrd", ".nhdr"):  # after a blank line there is data
        text = re.split(rb"\n\r?\n", text, maxsplit=1)[0]
    if not (found := DATA.search(text)):
        return text, "", 0
    return text[: found.start()], found[1].decode(errors="surrogateescape").strip(), found.end()


def is_store(path: str | Path) -> bool:
    """Return whether a path is a folder whose name is that of a Zarr store."""
    return str(path).lower().endswith(".zarr") and os.path.isdir(path)


def files_of(path: str | Path) -> list[Path]:
    """Return the files that are read for a grid: itself, and those that it names or holds."""
    file, _ = split_member(path)
    if is_store(file):
        return sorted(Path(at, name) for at, _, names in os.walk(file) for name in names)
    kind, names = file.suffix.lower(), list[str]()
    try:
        if kind in HEADERS and file.is_file():  # opening a pipe would block
            names = [split_header(file)[1]]
        elif kind == ".hdr":
            names = [f"{file.stem}.img", f"{file.stem}.img.gz"]
        return [file, *(part for name in names if (part := file.parent / name).is_file())]
    except (OSError, ValueError):
        return [file]
