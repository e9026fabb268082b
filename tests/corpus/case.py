"""One bad or odd input: files in a folder, a command line, and what it may make there."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path, PurePath
from typing import Any

import numpy as np

Content = bytes | Callable[[Path], Any]
"""What a file holds, or how something that is no plain file is made at a path."""

Files = Mapping[str, Content]


@dataclass(frozen=True)
class Case:
    """One run of the command line, in a folder of its own."""

    name: str  # theme, a slash, and what is odd; unique
    words: tuple[str, ...]  # the command line, after the name of the program
    files: Files = field(default_factory=dict)  # what lies in the folder, by path
    makes: tuple[str, ...] = ()  # patterns of the paths that the command may make or change
    alone: bool = False  # it may hang, crash or fill the memory: only in a child

    @property
    def theme(self) -> str:
        """Return the part of the name before the slash."""
        return self.name.partition("/")[0]

    @property
    def command(self) -> str:
        """Return which command runs."""
        return self.words[0] if self.words else ""

    def build(self, folder: Path) -> None:
        """Make the files, the folders above them too."""
        for name, content in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                content(path)


def upsample(
    name: str, files: Files, *options: str, source: str = "", target: str = "out.ply", **more: bool
) -> Case:
    """Return a case of ``upsample`` with the small network; by default of the first file."""
    words = ("upsample", source or next(iter(files)), target, *_network(options), *options)
    return Case(name, words, files, _made(target), **more)


def batch(name: str, files: Files, *options: str, source: str = "", **more: bool) -> Case:
    """Return a case of ``batch`` in one process, into the folder ``out``."""
    words = ("batch", source or next(iter(files)), "--out", "out", *_network(options))
    return Case(name, (*words, "--jobs", "1", *options), files, ("out", "out/*"), **more)


def sample(
    name: str, files: Files, *options: str, source: str = "", target: str = "out.npz"
) -> Case:
    """Return a case of ``sample``; libraries in C read the meshes."""
    words = ("sample", source or next(iter(files)), target, *options)
    return Case(name, words, files, _made(target), alone=True)


def _network(options: tuple[str, ...]) -> tuple[str, ...]:
    return () if "--model" in options or "--quality" in options else ("--quality", "fast")


def _made(target: str) -> tuple[str, ...]:
    """Return the pattern of a target: a slash at its end means nothing to the commands."""
    return (escape(PurePath(target).as_posix()),)


def rng_of(name: str, seed: int) -> np.random.Generator:
    """Return the random numbers of one case, whatever other cases there are."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def ball(shape: tuple[int, ...] = (12, 12, 12), radius: float = 0.3) -> np.ndarray:
    """Return the distances to a ball, its radius as a share of the shortest axis, float32."""
    middle = np.array(shape)[:, None, None, None] / 2 - 0.63
    away = np.linalg.norm(np.indices(shape) - middle, axis=0)
    return (away - radius * min(shape)).astype(np.float32)


def words(*lines: str) -> list[str]:
    """Return the words of some lines."""
    return " ".join(lines).split()


def npy(array: Any, **options: Any) -> bytes:
    """Return an array as the bytes of an .npy file."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asanyarray(array), **options)
    return file.getvalue()


def npz(**arrays: Any) -> bytes:
    """Return arrays as the bytes of an .npz file."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


ODD = bytes([0x00, 0xFF, 0x7F, 0x80, 0x0A, 0x0D, 0x20, 0x27, 0x28, 0x29, 0x2C, 0x2D, 0x30, 0x39])


def mutate(data: bytes, rng: np.random.Generator, first: int = 0, last: int | None = None) -> bytes:
    """Return the bytes with one to four changes between two positions."""
    last = len(data) if last is None else min(last, len(data))
    for _ in range(int(rng.integers(1, 5))):
        if last <= first:
            break
        data = _change(data, rng, int(rng.integers(first, last)))
        last = min(last, len(data))
    return data


def _change(data: bytes, rng: np.random.Generator, at: int) -> bytes:
    length = int(rng.integers(1, 9))
    match int(rng.integers(7)):
        case 0:  # one bit
            return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
        case 1:
            return data[:at] + rng.bytes(1) + data[at + 1 :]
        case 2:
            return data[:at] + bytes([ODD[int(rng.integers(len(ODD)))]]) + data[at + 1 :]
        case 3:
            return data[:at] + rng.bytes(length) + data[at:]
        case 4:
            return data[:at] + data[at + length :]
        case 5:  # a piece twice
            return data[: at + length] + data[at:]
        case _:
            return data[:at] + b"\xff" * length + data[at + length :]
