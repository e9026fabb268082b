"""Temporary names of unfinished files, and the removal of those that killed processes left.

Process 123 writes ``.part.ply.123.part`` beside ``part.ply`` and holds a lock on it meanwhile. A
file without a lock was abandoned; where there are no locks, one whose process has ended.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import WriteError

# File systems allow names of 255 bytes (some 143); the name of a spool file is 9 bytes longer.
LONGEST = 96
PART = re.compile(r"(?P<stem>\..+\.)(?P<pid>\d+)\.part(\.\w+)?", re.DOTALL)


def part_path(target: Path) -> Path:
    """Return the path of the unfinished target that this process writes."""
    return target.with_name(f"{_stem(target.name)}{os.getpid()}.part")


def _stem(name: str) -> str:
    """Return the prefix of the names of a target's parts; long names are hashed."""
    raw = name.encode(
        "utf-8", "surrogatepass"
    )  # a batch report may hold names that no file can have
    if len(raw) <= LONGEST:
        return f".{name}."
    from hashlib import sha256  # loads OpenSSL, and long names are rare

    return f".{sha256(raw).hexdigest()[:32]}."


@contextmanager
def reserved_part(target: Path) -> Iterator[Path]:
    """Create and lock this process's part of a target; remove it at the end if it still exists.

    Raises
    ------
    WriteError
        If this process is already writing the target.
    """
    remove_abandoned_parts([target])
    part = part_path(target)
    try:
        file = os.open(part, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    except FileExistsError:
        raise WriteError(f"{target} is being written already: wait for it") from None
    has_lock = take_lock(file) is not None
    if not has_lock:
        os.close(file)
    try:
        yield part
    finally:
        part.unlink(missing_ok=True)
        if has_lock:
            os.close(file)


def remove_abandoned_parts(targets: Iterable[Path], pid: int | None = None) -> None:
    """Remove unfinished parts of the targets that ended processes, or process ``pid``, left."""
    stems_in: dict[Path, set[str]] = {}
    for target in targets:
        stems_in.setdefault(target.parent, set()).add(_stem(target.name))
    for folder, stems in stems_in.items():
        with suppress(OSError):
            for name in os.listdir(folder):
                match = PART.fullmatch(name)
                if match and match["stem"] in stems:
                    found = int(match["pid"])
                    if found == pid or _is_abandoned(folder / name, found):
                        (folder / name).unlink(missing_ok=True)


def _is_abandoned(path: Path, pid: int) -> bool:
    """Return whether no process holds a part's lock; without locks, whether its process ended."""
    try:
        file = os.open(path, os.O_RDWR)
    except OSError:  # another user's, or gone
        return False
    try:
        taken = take_lock(file)
    finally:
        os.close(file)
    return taken if taken is not None else not _is_running(pid)


def take_lock(file: int) -> bool | None:
    """Lock an open file until it is closed.

    Return whether that worked, or None if the system or file system has no locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def _is_running(pid: int) -> bool:
    """Return whether a process is running; False on Windows, where open files cannot be removed."""
    if os.name == "nt":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # another user's
    with suppress(OSError):  # a zombie has ended
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True
