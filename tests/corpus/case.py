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
    """One run of the command line.

    Attributes
    ----------
    name : str
        Theme, a slash, and what is odd; unique.
    words : tuple of str
        The command line, after the name of the program; it runs in the folder of the files.
    files : mapping
        What lies in the folder, by path.
    makes : tuple of str
        Glob patterns of the paths that the command may make or change.
    alone : bool
        It may hang, crash or fill the memory: only in a child.
    """

    name: str
    words: tuple[str, ...]
    files: Files = field(default_factory=dict)
    makes: tuple[str, ...] = ()
    alone: bool = False

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
    name: str,
    files: Files,
    *options: str,
    source: str = "in.npy",
    target: str = "out.ply",
    alone: bool = False,
) -> Case:
    """Return a case of ``upsample`` with the small network."""
    words = ("upsample", source, target, *small_network(options), *options)
    return Case(name, words, files, made(target), alone)


def batch(
    name: str, files: Files, *options: str, source: str = "in.npy", alone: bool = False
) -> Case:
    """Return a case of ``batch`` in one process, into the folder ``out``."""
    words = ("batch", source, "--out", "out", *small_network(options), "--jobs", "1", *options)
    return Case(name, words, files, ("out", "out/*"), alone)


def sample(
    name: str,
    files: Files,
    *options: str,
    source: str,
    target: str = "out.npz",
    alone: bool = False,
) -> Case:
    """Return a case of ``sample``."""
    return Case(name, ("sample", source, target, *options), files, made(target), alone)


def small_network(options: tuple[str, ...]) -> tuple[str, ...]:
    """Return the words for the small network, unless another is given."""
    return () if "--model" in options or "--quality" in options else ("--quality", "fast")


def made(target: str) -> tuple[str, ...]:
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
