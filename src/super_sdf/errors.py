"""Everything that this package raises on purpose.

- ``SuperSdfError``: the base; its text is one line: what was wrong, the value seen, the way out.

  - ``GridError`` (also ``ValueError``): the samples are not a usable signed distance grid.

    - ``NoSurfaceError``: they are, but no surface is to be found in them.

  - ``MeshError`` (also ``ValueError``): a reference mesh bounds no solid.
  - ``OptionError`` (also ``ValueError``): an argument has no meaning (an odd factor, say).
  - ``FileError`` (also ``OSError``): a file cannot be read or written.

    - ``WriteError``: it cannot be made where it was asked for, which is not the input's fault.

  - ``ModelError`` (also ``ValueError``): an ONNX file that does not keep the network's contract.
  - ``DeviceError`` (also ``RuntimeError``): a device was asked for that cannot run here.
  - ``OutOfMemoryError`` (also ``MemoryError``): the work would not fit in memory; it was not begun.
"""


class SuperSdfError(Exception):
    """Base of this package's errors."""


class GridError(SuperSdfError, ValueError):
    """The samples are not a usable signed distance grid."""


class NoSurfaceError(GridError):
    """No surface is to be found in the samples."""


class MeshError(SuperSdfError, ValueError):
    """A reference mesh bounds no solid."""


class OptionError(SuperSdfError, ValueError):
    """An argument has no meaning."""


class FileError(SuperSdfError, OSError):
    """A file cannot be read or written."""


class WriteError(FileError):
    """A file cannot be made where it was asked for: no room, no permission, a name taken."""


class ModelError(SuperSdfError, ValueError):
    """A network file does not keep the network's contract."""


class DeviceError(SuperSdfError, RuntimeError):
    """A device was asked for that cannot run here."""


class OutOfMemoryError(SuperSdfError, MemoryError):
    """The work would not fit in memory; it was not begun."""
