"""Everything that this package raises on purpose, below ``SuperSdfError``.

A message is one line: what is wrong, the value seen, the way out. Each class is also one of
Python's own, so that code which knows only these catches it. ``check_modules`` raises one where an
optional library is missing.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterable, Sequence
from importlib.util import find_spec

FLAG = re.compile(r"(?<!install )--([a-z-]+)(?: ('[^']*'|[\w.,+-]*\w))?( (?=--))?")
VERBS = ("is", "are", "has", "does", "needs", "takes")
WORDS = ("and", "or", "if", "out", "to", "with", "for")
SWITCHES = {"open": "cap=False", "cap": "cap=True", "force": "force=True"}
SWITCHES |= {"labels all": "reconstruct_labels(values)"}


class SuperSdfError(Exception):
    """Base class of all errors of this package.

    ``str`` of an error names options as keywords, ``max_memory=4G``; ``flagged``, for the command
    line, as flags, ``--max-memory 4G``.
    """

    names: Sequence[str] = ()  # of the arrays in a file, where one has to be chosen

    @property
    def flagged(self) -> str:
        """The message for users of the command line."""
        return str(self.args[0]) if self.args else ""

    def __str__(self) -> str:
        return in_python(self.flagged)


class SuperSdfWarning(UserWarning):
    """What may be wrong with a mesh; ``Mesh.warnings`` has the same sentences."""


def flag(name: str) -> str:
    """Return an option as messages name it."""
    return f"--{name.replace('_', '-')}"


def in_python(flagged: str) -> str:
    """Return a message with keywords in place of flags."""
    return FLAG.sub(_keyword, flagged)


def tell(notes: Iterable[str], doubts: Iterable[str]) -> list[tuple[str, ...]]:
    """Log notes and warn whoever called a public function; return both as Python says them."""
    told = [tuple(map(in_python, sentences)) for sentences in (notes, doubts)]
    for note in told[0]:
        logging.getLogger("super_sdf").info(note)
    for doubt in told[1]:
        warnings.warn(doubt, SuperSdfWarning, stacklevel=3)
    return told


def in_a_line(error: BaseException) -> str:
    """Return what went wrong, for users of the command line."""
    if isinstance(error, SuperSdfError):
        return " ".join(error.flagged.splitlines())
    if isinstance(error, MemoryError):
        return "out of memory: use a smaller --factor or grid"
    return f"{type(error).__name__}: {error}"


def _keyword(found: re.Match[str]) -> str:
    """Return the keyword of Python for a flag and the word behind it, which may be its value."""
    name, value = found[1].replace("-", "_"), found[2]
    more = (" " if value in WORDS else ", ") if found[3] else ""
    if call := SWITCHES.get(f"{name} {value}"):
        return call + more
    if value in VERBS:
        return f"{name} {value}"
    if value is None or value in WORDS:
        return SWITCHES.get(name, f"{name}=") + (f" {value}" if value else "") + more
    if value.isidentifier():
        value = repr(value)
    return f"{name}=({value})" if "," in value else f"{name}={value}{more}"


class GridError(SuperSdfError, ValueError):
    """The samples are not a usable signed distance grid."""


class NoSurfaceError(GridError):
    """The samples contain no surface."""


class MeshError(SuperSdfError, ValueError):
    """A mesh does not bound a solid, has invalid arrays, or has holes between its tiles."""


class OptionError(SuperSdfError, ValueError):
    """An argument is invalid, such as an odd factor."""


class OptionTypeError(OptionError, TypeError):
    """An argument has the wrong type."""


class FileError(SuperSdfError, OSError):
    """A file cannot be read or written."""


class WriteError(FileError):
    """An output file cannot be created: disk full, no permission, or the name is taken."""


class ModelError(SuperSdfError, ValueError):
    """An ONNX file does not fulfil the network's contract."""


class DeviceError(SuperSdfError, RuntimeError):
    """The requested device cannot run here."""


class OutOfMemoryError(SuperSdfError, MemoryError):
    """The work would not fit in memory and was not begun."""


class ClusterError(SuperSdfError, RuntimeError):
    """A cluster cannot be reached, its workers lack something, or it was lost."""


def seen(value: object) -> str:
    """Return the repr of a value for error messages: on one line, at most 60 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


EXTRAS = {
    "nifti": ("nibabel",),
    "nrrd": ("nrrd",),
    "metaimage": ("SimpleITK",),
    "vti": ("vtkmodules",),
    "tiff": ("tifffile",),
    "hdf5": ("h5py",),
    "zarr": ("zarr",),
    "vdb": ("numcodecs",),
    "mrc": ("mrcfile",),
    "mat": ("h5py",),
    "netcdf": ("h5py",),
    "dicom": ("pydicom",),
    "3mf": ("lxml", "networkx"),
    "pyvista": ("pyvista",),
    "simplify": ("igl", "manifold3d", "pyfqmr"),
    "eval": ("igl",),
    "report": ("igl", "manifold3d", "pyfqmr"),
    "cluster": ("distributed",),
}
"""The modules that each extra installs."""


def to_install(extra: str, modules: tuple[str, ...] | None = None) -> str:
    """Return which modules of an extra, all or some, are missing and how to install them, or ""."""
    missing = [name for name in modules or EXTRAS[extra] if find_spec(name) is None]
    how = f"{', '.join(missing)}: pip install -e '.[{extra}]' in a clone of super-sdf"
    return how if missing else ""


def check_modules(what: str, extra: str, modules: tuple[str, ...] | None = None) -> None:
    """Raise FileError if modules that ``what`` needs, all of an extra or some, are missing."""
    if missing := to_install(extra, modules):
        raise FileError(f"{what} needs {missing}")
