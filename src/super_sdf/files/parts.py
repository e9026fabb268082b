"""Names of files that are not finished, and what is done with those that nobody finishes.

Beside ``part.ply`` process 123 writes ``.part.ply.123.part``, and holds a lock on it while it does:
a file without its lock, or without its process where locks are not known, was left by a kill.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import WriteError

# File systems allow 255 bytes (some 143), and a spool's name is longer still by 9.
LONGEST = 96
PART = re.compile(r"(?P<stem>\..+\.)(?P<pid>\d+)\.part(\.\w+)?", re.DOTALL)


def part_path(target: Path) -> Path:
    """Return where this process writes what is to become the target."""
    return target.with_name(f"{_stem(target.name)}{os.getpid()}.part")


def _stem(name: str) -> str:
    """Return what the names of a target's parts begin with; a digest stands for a long name."""
    raw = name.encode("utf-8", "surrogatepass")  # a ledger may name what no file can be called
    if len(raw) <= LONGEST:
        return f".{name}."
    from hashlib import sha256  # it loads OpenSSL, and long names are rare

    return f".{sha256(raw).hexdigest()[:32]}."


@contextmanager
def reserved_part(target: Path) -> Iterator[Path]:
    """Make this process's part of a target, locked; in the end it is removed if it is still there.

    Raises
    ------
    WriteError
        If this process is writing the target already.
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
    """Remove what ended processes, or the one given, left of unfinished targets."""
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
    """Say whether nobody holds a part's lock; without locks, whether its process has ended."""
    try:
        file = os.open(path, os.O_RDWR)
    except OSError:  # somebody else's, or gone
        return False
    try:
        taken = take_lock(file)
    finally:
        os.close(file)
    return taken if taken is not None else not _lives(pid)


def take_lock(file: int) -> bool | None:
    """Lock an open file, until it is closed, if nobody else has; None where there are no locks."""
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


def _lives(pid: int) -> bool:
    """Say whether a process has this number; on Windows no open file can be removed anyhow."""
    if os.name == "nt":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # somebody else's
    with suppress(OSError):  # ended, though nobody has asked how yet
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True
