"""Writing refined fields: sparse ``.npz``, dense ``.npy`` and ``.vti``, complete or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Protocol

from ..errors import OptionError, OptionTypeError, OutOfMemoryError, WriteError, seen
from ..files.output import check_free, free_space, naming, replacing
from ..machine.extras import check_modules
from ..machine.memory import held_memory, in_words, memory_bound
from ..options import check_path
from ..steps.cap import check_all_seen
from ..steps.field import FineField
from ..steps.lattice import fine_grid, lattice_shape
from .dense import BYTES, NpyWriter
from .sparse import SparseWriter
from .vti import VtiWriter


class FieldWriter(Protocol):
    """Writes a field that comes slab by slab."""

    def add(self, field: FineField) -> None:
        """Write the own planes of a slab's field."""
        ...

    def finish(self) -> None:
        """Complete the file."""
        ...


Shape = tuple[int, int, int]


@dataclass(frozen=True)
class FieldFormat:
    """A file format of refined fields.

    Attributes
    ----------
    writer : callable
        Takes the path of the file, the number of nodes along each axis of the fine lattice, and an
        ExitStack that closes what it opens.
    dense : bool
        Whether the file holds every node of the fine lattice.
    in_memory : bool
        Whether the whole lattice must fit in memory.
    extra : str or None
        The extra that installs its library.
    """

    writer: Callable[[Path, Shape, ExitStack], FieldWriter]
    dense: bool = False
    in_memory: bool = False
    extra: str | None = None


FORMATS = {
    ".npz": FieldFormat(SparseWriter),
    ".npy": FieldFormat(NpyWriter, dense=True),
    ".vti": FieldFormat(VtiWriter, dense=True, in_memory=True, extra="vti"),
}
FIELD_SUFFIXES = tuple(FORMATS)


def check_field_target(path: str | Path, *, force: bool = False) -> Path:
    """Return the path if a field can be written there; called before the work starts.

    Raises
    ------
    OptionError
        If the suffix is not one of ``FIELD_SUFFIXES``.
    FileError
        If the file exists and ``force`` is not set, the folder cannot be written to, or the
        library for the format is missing.
    """
    path = check_path(path, "path")
    suffix = path.suffix.lower()
    if suffix == ".vdb":
        raise OptionError(
            f"{path} cannot be written: OpenVDB's own module cannot be installed with pip; write "
            ".npz, and convert it with that module as docs/fields.md shows"
        )
    if suffix not in FORMATS:
        raise OptionError(f"{path} is not a field file: give one of {', '.join(FIELD_SUFFIXES)}")
    if extra := FORMATS[suffix].extra:
        check_modules(f"Writing {suffix}", extra)
    return check_free(path, force=force)


def check_field_fits(path: Path, shape: Shape, max_memory: int | None = None) -> None:
    """Raise an error if a dense file of a lattice does not fit on the disk, or .vti in memory."""
    format_ = FORMATS[path.suffix.lower()]
    if not format_.dense:
        return
    size = BYTES * prod(shape)
    what = f"{' x '.join(map(str, shape))} values take {in_words(size)}"
    free, bound = free_space(path), memory_bound(max_memory)
    if size > free:
        raise WriteError(
            f"{path} cannot be written: {what}, {in_words(free)} are free there; write .npz, which "
            "is sparse"
        )
    left = None if bound is None else bound - (held_memory() or 0)
    if format_.in_memory and left is not None and size > left:
        raise OutOfMemoryError(
            f"{path} cannot be written: {what} of memory, {in_words(max(left, 0))} are left; "
            "write .npy, which is written plane by plane, or .npz, which is sparse"
        )


class FieldFile:
    """A file of a field that is being written; errors name it.

    Parameters
    ----------
    path : Path
        The file, as the user named it.
    shape : three ints
        Nodes of the fine lattice along each axis.
    writer : FieldWriter
        What writes it.

    Attributes
    ----------
    place : dict
        Shape, spacing and origin of the fine lattice, once there is a field.
    """

    def __init__(self, path: Path, shape: Shape, writer: FieldWriter) -> None:
        self.path, self.shape, self.writer = path, shape, writer
        self.place: dict[str, Any] = {}

    def add(self, field: FineField) -> None:
        """Write the own planes of a slab's field."""
        if not self.place:
            check_all_seen(field.placed, "write the mesh alone, without its field")
            fine = fine_grid(field)
            self.place = {"spacing": list(fine.spacing), "origin": list(fine.origin)}
        with naming(self.path):
            self.writer.add(field)

    def finish(self) -> None:
        """Complete the file."""
        with naming(self.path):
            self.writer.finish()

    def report(self) -> dict[str, Any]:
        """Return what was written, as it stands in JSON."""
        return {"path": str(self.path), "shape": list(self.shape), **self.place}


@contextmanager
def saving_field(path: Path, shape: Shape, *, force: bool = False) -> Iterator[FieldFile]:
    """Yield a file to write a field to; it appears at the end, if ``finish`` was called.

    ``shape`` is the number of nodes of the fine lattice along each axis.
    """
    with replacing(path, force=force) as part, ExitStack() as files:
        yield FieldFile(path, shape, FORMATS[path.suffix.lower()].writer(part, shape, files))


def write_field(field: FineField, path: str | Path, *, force: bool = False) -> None:
    """Write a refined field to a file, in the format of its suffix.

    Parameters
    ----------
    field : FineField
        From ``upsample``.
    path : path
        The file: .npz for the sparse field, which ``read_field`` reads back; .npy or .vti for the
        whole fine lattice. docs/fields.md describes them.
    force : bool
        Replace an existing file.

    Raises
    ------
    OptionError
        If the suffix is unknown, or the field was made without its grid.
    FileError
        If the file exists and ``force`` is not set, or cannot be written; if the field is one from
        a file and the format is dense, which takes the coarse samples.
    OutOfMemoryError
        If a .vti would not fit in memory.
    """
    if not isinstance(field, FineField):
        raise OptionTypeError(f"field is {seen(field)}: give one from upsample(grid, network)")
    path = check_field_target(path, force=force)
    shape = lattice_shape(field.placed.shape, field.factor)
    check_field_fits(path, shape)
    with saving_field(path, shape, force=force) as writer:
        writer.add(field)
        writer.finish()
