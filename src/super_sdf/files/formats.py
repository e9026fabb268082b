"""Grid files by their names: the table of formats, and which files are read for a grid.

A new format is a row of the table, and its reader in ``readers``. Only regular files are read:
opening a named pipe may wait forever. Some files name others, which must lie beside them.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from ..errors import FileError, OptionError, seen
from ..options import MESH_FORMATS

# What people give by mistake: surfaces, which have to be sampled first.
SURFACES = (*(f".{name}" for name in MESH_FORMATS), ".gltf")
# What is no grid file here, and the way out: {0} is the file, {1} its name without the suffix.
CAD = "is a CAD model: export it as {1}.stl, then super-sdf sample {1}.stl {1}.npz -n 64"
PYTHON = 'is not read: convert it by python -c "import '
NIBABEL = "p.save(p.Nifti1Image.from_image(p.load('{0}')), '{1}.nii.gz')\""
WAYS_OUT = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), CAD),
    **dict.fromkeys((".mnc", ".head"), PYTHON + "nibabel as p; " + NIBABEL),
    ".nvdb": "is NanoVDB: make OpenVDB of it with OpenVDB's tool nanovdb_convert {0} {1}.vdb",
    ".img": "holds the samples of an Analyze file: give its header {1}.hdr",
    ".vtr": PYTHON + "pyvista as p; p.read('{0}').save('{1}.vtk')\"",
    ".vtu": PYTHON
    + "pyvista as p; m = p.read('{0}'); p.create_grid(m, (64, 64, 64)).sample(m).save('{1}.vti')\"",
    ".cube": PYTHON + "vtk as p; r = p.vtkGaussianCubeReader2(); r.SetFileName('{0}'); r.Update(); "
    "w = p.vtkXMLImageDataWriter(); w.SetInputData(r.GetGridOutput()); "
    "w.SetFileName('{1}.vti'); w.Write()\"",
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


MRC = (".mrc", ".map", ".ccp4", ".rec", ".mrc.gz", ".map.gz", ".ccp4.gz")
FORMATS = (
    GridFormat("npy", "NumPy", (".npy",), "numpy", axes="xyz"),
    GridFormat("npz", "NumPy", (".npz",), "numpy", axes="xyz", has_members=True),
    GridFormat("nifti", "NIfTI", (".nii", ".nii.gz"), "nibabel", "nifti"),
    GridFormat("nrrd", "NRRD", (".nrrd", ".nhdr"), "headers", "nrrd"),
    GridFormat("metaimage", "MetaImage", (".mha", ".mhd"), "headers", "metaimage"),
    GridFormat("vtk", "VTK image data", (".vti",), "vtk", "vti", has_members=True),
    GridFormat("tiff", "TIFF stack", (".tif", ".tiff"), "tifffile", "tiff", "zyx"),
    GridFormat("hdf5", "HDF5", (".h5", ".hdf5", ".hdf", ".ims"), "h5py", "hdf5", "zyx", True),
    GridFormat("zarr", "Zarr", (".zarr", ".zarr.zip"), "zarr", "zarr", "zyx", True),
    GridFormat("vdb", "OpenVDB", (".vdb",), "vdb", "vdb", has_members=True),
    GridFormat("sdf", "SDFGen", (".sdf",), "numpy"),
    GridFormat("mgh", "FreeSurfer", (".mgz", ".mgh"), "nibabel", "nifti"),
    GridFormat("analyze", "Analyze", (".hdr",), "nibabel", "nifti"),
    GridFormat("mrc", "MRC", MRC, "mrcfile", "mrc"),
    GridFormat("vtk", "legacy VTK", (".vtk",), "vtk", "vti", has_members=True),
    GridFormat("vtk", "VTKHDF", (".vtkhdf",), "vtk", "vti", has_members=True),
    GridFormat("netcdf", "NetCDF", (".nc", ".nc4", ".cdf"), "h5py", "netcdf", "zyx", True),
    GridFormat("mat", "MATLAB", (".mat",), "h5py", "mat", "xyz", True),
    GridFormat("dicom", "DICOM", (".dcm",), "pydicom", "dicom", has_members=True),
)
DICOM = GridFormat("dicom", "DICOM", ("a folder",), "pydicom", "dicom", has_members=True)
"""A folder that is no Zarr store: the names of slices end in anything."""

GRID_SUFFIXES = tuple(suffix for format_ in FORMATS for suffix in format_.suffixes)
_ENDS = "|".join(map(re.escape, sorted(GRID_SUFFIXES, key=len, reverse=True)))
_WITH_MEMBER = re.compile(
    rf"(?P<file>.*?[^/](?:{_ENDS}))(?P<member>(?::[^\[]+|:.+?)?(?:\[\d+\])*)", re.I | re.S
)


def find_format(path: str | Path) -> GridFormat:
    """Return the format of a grid file by its name; raise OptionError if it is none, or a mesh."""
    file, member = split_member(path)
    if ending := _ending(file):
        format_ = next(format_ for format_ in FORMATS if ending in format_.suffixes)
        if member and member[0] != "[" and not format_.has_members:
            raise OptionError(f"{format_.name} files hold one array: leave out :{member}")
        return format_
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


def list_formats(*, with_members: bool = False) -> str:
    """Return the formats and their suffixes for help texts, or names of those ``with_members``."""
    suffixes: dict[str, tuple[str, ...]] = {}
    for format_ in (*FORMATS, DICOM):
        suffixes[format_.name] = (*suffixes.get(format_.name, ()), *format_.suffixes)
    listed = [f"{name} ({', '.join(suffixes[name])})" for name in suffixes]
    if with_members:
        listed = list(dict.fromkeys(each.name for each in FORMATS if each.has_members))
    return f"{', '.join(listed[:-1])} or {listed[-1]}"


NAMED = list_formats(with_members=True)
"""The formats whose files may hold several arrays, for help texts."""

# Files

KINDS = {stat.S_IFDIR: "folder", stat.S_IFIFO: "named pipe", stat.S_IFSOCK: "socket"}
KINDS |= {stat.S_IFCHR: "device", stat.S_IFBLK: "device"}
REASONS = {
    errno.ENOENT: "does not exist",
    errno.ENOTDIR: "does not exist: the path before its last / is not a folder",
    errno.EACCES: "cannot be read: permission denied",
}
MARKS = ("zarr.json", ".zarray", ".zgroup")  # one of them makes a folder a Zarr store
HEADERS = (".mhd", ".mha", ".nhdr", ".nrrd")  # text that may name data files, a line each
LONGEST_HEADER = 1 << 20  # bytes, with a list of files
META_DATA = re.compile(rb"^ElementDataFile *[=:] *([^\n]*)\n?", re.M)
NRRD_DATA = re.compile(rb"^[ \t]*data ?file[ \t]*:=? *([^\n]*)\n?", re.M)
WEIGHTS = re.compile(rb"\n\x08location\x12([\x01-\x7f])")  # of a network: before a name, its length


def check_regular_file(path: str | Path) -> Path:
    """Return the path if it is a readable regular file, or a link to one, else raise FileError.

    The file is not opened, so this never blocks. An empty file is refused, too.
    """
    try:
        state = os.stat(path)
    except OSError as error:
        raise FileError(f"{path} {reason_of(error)}") from None
    except ValueError:  # a NUL, or a character that the file system's encoding lacks
        raise FileError(f"{str(path)!r} is not a valid file name") from None
    if not stat.S_ISREG(state.st_mode):
        kind = KINDS.get(stat.S_IFMT(state.st_mode), "special file")
        raise FileError(f"{path} is a {kind}: give a file")
    if not os.access(path, os.R_OK):
        raise FileError(f"{path} {REASONS[errno.EACCES]}")
    if not state.st_size:  # such as files in /proc, which the system makes up as they are read
        raise FileError(f"{path} is empty: give a file with something in it")
    return Path(path)


def check_beside(path: Path, name: str) -> Path:
    """Return the file that another one, or a folder, names as part of it: in the folder, or below.

    A file that is a link may have its parts beside the file that it leads to. Raises FileError if
    it is anywhere else, or no regular file.
    """
    homes = (path,) if path.is_dir() else (path.parent, path.resolve().parent)
    other = homes[0] / name
    if not PurePath(name).is_absolute() and ".." not in PurePath(name).parts:
        check_regular_file(other)
        if any(other.resolve().is_relative_to(home.resolve()) for home in homes):
            return other
    said = f"{path} names the file {seen(name)}, which is not in its folder"
    raise FileError(f"{said}: put both into one folder")


class Header(NamedTuple):
    """A header in text, and the entry in it that names the files with its data."""

    before: bytes  # the entry
    entry: str  # a name, ``NAME%03d.raw 1 20 1``, or ``LIST``
    rest: bytes  # what follows the entry: with ``LIST``, a name in each line
    start: int  # of the rest in the file, 0 if there is no entry

    @property
    def lists(self) -> bool:
        """Whether a list follows."""
        return self.entry.upper().startswith("LIST")

    def names(self) -> list[str]:
        """Return the names of the files with the data."""
        if self.lists:
            listed = self.rest.decode(errors="surrogateescape").splitlines()
            return [name for name in listed if name.strip()]
        if "%" in self.entry:
            pattern, *numbers = self.entry.split()
            if not re.fullmatch("[^%]*%0?[0-9]?d[^%]*", pattern) or len(numbers) < 2:
                raise FileError(f"its data file is {seen(self.entry)}: give NAME%03d.raw 1 20 1")
            first, last, step = (int(number) for number in (*numbers, "1")[:3])
            return [pattern % number for number in range(first, last + 1, step)]
        return [self.entry] * bool(self.entry)


def split_header(path: Path) -> Header:
    """Return the header at the beginning of a NRRD or MetaImage file."""
    with path.open("rb") as file:
        text = file.read(LONGEST_HEADER)
    found = META_DATA.search(text)
    if path.suffix.lower() in (".nrrd", ".nhdr"):  # after a blank line there is data
        found = NRRD_DATA.search(re.split(rb"\n\r?\n", text, maxsplit=1)[0])
    if not found:
        return Header(text, "", b"", 0)
    entry = found[1].decode(errors="surrogateescape").strip()
    return Header(text[: found.start()], entry, text[found.end() :], found.end())


def parse_json(text: str | bytes, what: str) -> Any:
    """Return what JSON holds; FileError, naming ``what`` is read, if it is damaged."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{what} is no JSON: {error}") from None


def reason_of(error: OSError) -> str:
    """Return why the system refuses to read a file, as the words after its name."""
    return REASONS.get(error.errno or 0) or f"cannot be read: {error.strerror or error}"


def is_store(path: str | Path) -> bool:
    """Return whether a path is a folder whose name is that of a Zarr store."""
    return str(path).lower().endswith(".zarr") and os.path.isdir(path)


def check_grid_file(path: str | Path) -> None:
    """Raise FileError unless the file that ``FILE`` or ``FILE:NAME`` names can be read."""
    file, _ = split_member(path)
    if is_store(file):
        if not any((file / mark).is_file() for mark in MARKS):
            raise FileError(f"{file} is no Zarr store: it holds none of {', '.join(MARKS)}")
    elif find_format(path) is not DICOM:
        check_regular_file(file)


def files_of(path: str | Path) -> list[Path]:
    """Return the files that are read for a grid or a network: itself, and those that it names.

    Of a Zarr folder they are all in it; of what cannot be read it is the file itself.
    """
    file, _ = split_member(path)
    if is_store(file):
        return sorted(Path(at, name) for at, _, names in os.walk(file) for name in names)
    try:  # opening a pipe would block
        named = {file.parent / name for name in _names_in(file)} if file.is_file() else set()
        return [file, *sorted(each for each in named - {file} if each.is_file())]
    except (OSError, ValueError):
        return [file]


def _names_in(file: Path) -> Iterator[str]:
    kind = file.suffix.lower()
    if kind == ".hdr":
        yield from (f"{file.stem}.img", f"{file.stem}.img.gz")
    elif kind == ".onnx":
        content = file.read_bytes()
        for match in WEIGHTS.finditer(content):
            yield os.fsdecode(content[match.end() : match.end() + match[1][0]])
    elif kind in HEADERS:
        yield from split_header(file).names()
