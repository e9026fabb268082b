"""Everything that this package raises on purpose, below ``SuperSdfError``.

A message is one line: what is wrong, the value seen, the way out. Each class is also one of
Python's own, so that code which knows only these catches it.
"""


class SuperSdfError(Exception):
    """Base class of all errors of this package."""


class GridError(SuperSdfError, ValueError):
    """The samples are not a usable signed distance grid."""


class NoSurfaceError(GridError):
    """The samples contain no surface."""


class MeshError(SuperSdfError, ValueError):
    """A reference mesh does not bound a solid, or slabs or bricks of a mesh do not meet."""


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
