"""Output files: asked for before the work starts, and there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import WriteError


def check_free(path: Path, *, force: bool = False) -> Path:
    """Return the path if a file can be made there."""
    if path.is_dir():
        raise WriteError(f"{path} is a folder: give a file")
    if path.exists() and not force:
        raise WriteError(f"{path} exists: remove it or use --force")
    if not path.parent.is_dir():
        raise WriteError(f"{path.parent} is no folder: make it first")
    if not os.access(path.parent, os.W_OK):
        raise WriteError(f"{path} cannot be written: no permission in {path.parent}")
    return path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside the target; it takes the target's place only if all goes well.

    What the system has against it is raised as WriteError.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise WriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
