"""Finds the files below a folder or matching a pattern, and reports unreadable folders.

Links to folders are followed where a pattern names them, but not below a folder or by ``**``, so
circular links do no harm.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path

from ..files.regular import is_store

OnError = Callable[[OSError], None]
"""Called with the error of a folder that cannot be read."""


def files_below(folder: Path, on_error: OnError) -> Iterator[Path]:
    """Yield everything below a folder that is not a folder itself, or a folder that is a grid."""
    for path, folders, names in os.walk(folder, onerror=on_error):
        stores = [name for name in folders if is_store(Path(path, name))]
        folders[:] = [name for name in folders if name not in stores]
        yield from (Path(path, name) for name in stores)
        yield from (Path(path, name) for name in names)


def matches(pattern: Path, on_error: OnError) -> list[Path]:
    """Return the paths that a glob pattern matches, each once; ``**`` matches any folders."""
    root = fixed_part(pattern)
    paths = [root]
    for part in pattern.parts[len(root.parts) :]:
        found = [path for start in paths for path in _step(start, part, on_error)]
        paths = list(dict.fromkeys(found))
    return paths


def fixed_part(pattern: Path) -> Path:
    """Return the folder before the first part of a path that has wildcards."""
    parts = pattern.parts
    first = next(i for i, part in enumerate(parts) if glob.has_magic(part))
    return Path(*parts[:first])


def _step(path: Path, part: str, on_error: OnError) -> Iterator[Path]:
    """Yield the paths in a folder that match one part of a pattern."""
    if part == "**":
        yield from _visible_below(path, on_error)
    elif glob.has_magic(part):
        yield from (path / name for name in _names(path, on_error) if _fits(name, part))
    elif os.path.lexists(path / part):
        yield path / part


def _visible_below(path: Path, on_error: OnError) -> Iterator[Path]:
    """Yield a path, and everything below it that is not hidden."""
    yield path
    for folder, folders, names in os.walk(path, onerror=on_error):
        below = (Path(folder, name) for name in folders if not name.startswith("."))
        kept = [path for path in below if not path.is_symlink()]
        folders[:] = [path.name for path in kept if not is_store(path)]
        yield from kept
        yield from (Path(folder, name) for name in names if not name.startswith("."))


def _names(path: Path, on_error: OnError) -> list[str]:
    """Return the names in a folder; none if it is a file."""
    try:
        return os.listdir(path)
    except (NotADirectoryError, FileNotFoundError):
        return []
    except OSError as error:
        on_error(error)
        return []


def _fits(name: str, part: str) -> bool:
    """Return whether a name matches; hidden ones only if the pattern starts with a dot."""
    return fnmatch(name, part) and (part.startswith(".") or not name.startswith("."))
