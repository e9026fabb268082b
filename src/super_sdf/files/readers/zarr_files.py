"""The files of a Zarr store: what its metadata names and which chunks there are, without zarr.

zarr makes the codecs that the metadata names when it opens an array, and takes chunks that are not
there for the fill value; here the one is checked, and the other counted.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from math import prod
from typing import IO, Any

import numpy as np

from ...errors import FileError, seen
from ..regular import check_beside, check_regular_file
from ..unpacking import PIECE
from ..volume import Request

ARRAY_2, ATTRIBUTES_2, NODE_3 = ".zarray", ".zattrs", "zarr.json"
# None of these runs what the store names, and all return numbers.
CODECS = {
    *("bytes", "endian", "transpose", "sharding_indexed", "crc32c"),
    *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zfpy", "zlib", "zstd"),
    *("adler32", "crc32", "fletcher32", "jenkins_lookup3"),
    *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
}
CHUNK_KEY = re.compile(r"(?:c[./])?(\d+(?:[./]\d+)*)")
NOT_STORED = 2**64 - 1  # as the place of a chunk in the index of a shard
CHECKSUM = 4  # bytes of CRC-32C after that index
MOST_ABSENT = 1 << 20  # chunks: to look for them takes a minute

Document = dict[str, Any]


class ZarrFiles:
    """The files of a Zarr store in a folder or a zip file, which may not lead out of it.

    ``sizes`` has the bytes that each file takes, by its key.
    """

    def __init__(self, request: Request) -> None:
        self.path = request.path
        self.zip: zipfile.ZipFile | None = None
        if self.path.is_dir():
            self.sizes = dict(self._listed(str(self.path), ""))
        else:
            self.zip = request.files.enter_context(zipfile.ZipFile(self.path))
            self.sizes = {info.filename: info.compress_size for info in self.zip.infolist()}

    def _listed(self, folder: str, before: str) -> Iterator[tuple[str, int]]:
        """Yield key and size of each file in a folder and below it."""
        for entry in os.scandir(folder):
            key = before + entry.name
            if entry.is_dir(follow_symlinks=False):
                yield from self._listed(entry.path, f"{key}/")
                continue
            if entry.is_symlink():
                check_beside(self.path, key)
            elif not entry.is_file():
                check_regular_file(entry.path)
            yield key, entry.stat().st_size

    def open(self, key: str) -> IO[bytes]:
        """Open a file of the store."""
        return self.zip.open(key) if self.zip else open(self.path / key, "rb")

    def document(self, key: str) -> Document:
        """Return a file of metadata, a JSON object; an empty one if the store has none."""
        if key not in self.sizes:
            return {}
        with self.open(key) as file:
            content = json.load(file)
        if not isinstance(content, dict):
            raise FileError(f"{self.path} is damaged: {key} is no JSON object")
        return content

    def arrays(self) -> dict[str, int]:
        """Return the number of axes of each array, by its path in the store."""
        counts = {}
        for key in self.sizes:
            path, _, name = key.rpartition("/")
            if name in (ARRAY_2, NODE_3):
                about = self.document(key)
                if name == ARRAY_2 or about.get("node_type") == "array":
                    counts[path] = len(about.get("shape", ()))
        return counts

    def axes_of(self, path: str) -> int:
        """Return the number of axes of an array, 0 if there is none at a path."""
        documents = (self.document(f"{path}/{name}") for name in (ARRAY_2, NODE_3))
        return max(len(about.get("shape", ())) for about in documents)

    def attributes(self, path: str) -> Document:
        """Return the attributes of an array or a group."""
        before = f"{path}/" if path else ""
        stated = self.document(before + NODE_3).get("attributes") or {}
        return {**self.document(before + ATTRIBUTES_2), **stated}

    def check_codecs(self, path: str) -> None:
        """Raise FileError if an array names a codec that is not in the list."""
        before = f"{path}/" if path else ""
        for key in (before + ARRAY_2, before + NODE_3):
            for codec in _codecs_of(self.document(key)):
                if codec not in CODECS:
                    raise FileError(
                        f"{self.path} names the codec {seen(codec)}, which is not among those that "
                        f"are read ({', '.join(sorted(CODECS))}): store it with one of these"
                    )

    def chunks_of(self, path: str, counts: Sequence[int]) -> dict[tuple[int, ...], str]:
        """Return the keys of the chunks, or shards, that are stored, by their indices."""
        before, chunks = f"{path}/" if path else "", {}
        for key in self.sizes:
            match = CHUNK_KEY.fullmatch(key, len(before)) if key.startswith(before) else None
            indices = tuple(map(int, re.split("[./]", match[1]))) if match else ()
            if len(indices) == len(counts) and all(i < n for i, n in zip(indices, counts)):
                chunks[indices] = key
        return chunks

    def absent(self, array: Any, path: str, stored: dict[tuple[int, ...], str]) -> tuple[int, int]:
        """Return how many chunks of an array are not stored, and how many it has."""
        total = prod(counts_of(array.shape, array.chunks))
        there = len(stored)
        if array_shards(array):
            there = sum(self._in_shard(array, path, *shard) for shard in stored.items())
        if total - there > MOST_ABSENT:
            raise FileError(
                f"{self.path} has {total:,} chunks, of which {there:,} are stored: store it in "
                "larger ones"
            )
        return total - there, total

    def _in_shard(self, array: Any, path: str, indices: tuple[int, ...], key: str) -> int:
        """Return how many chunks of a shard are stored, of those within the array."""
        codec = self.document(f"{path}/{NODE_3}".lstrip("/"))["codecs"][0]["configuration"]
        shard, chunk = array.shards, array.chunks
        left = [min(n - i * s, s) for n, i, s in zip(array.shape, indices, shard)]
        within = counts_of(left, chunk)
        names = [str(step.get("name")) for step in codec["index_codecs"]]
        if names not in (["bytes"], ["bytes", "crc32c"]):
            return prod(within)  # its index cannot be read here
        counts = counts_of(shard, chunk)
        size = 16 * prod(counts) + CHECKSUM * (len(names) - 1)
        with self.open(key) as file:
            if codec.get("index_location", "end") == "end":
                file.seek(-size, os.SEEK_END)
            index = np.frombuffer(file.read(size)[: 16 * prod(counts)], "<u8")
        places = index.reshape(*counts, 2)[tuple(map(slice, within))]
        return int((places[..., 0] != NOT_STORED).sum())

    def check_sums(self, keys: Sequence[str]) -> None:
        """Read files of a zip file to their ends, where their checksums are compared.

        zarr reads shards in parts, of which zip files have no checksum.
        """
        for key in keys if self.zip else ():
            with self.open(key) as file:
                while file.read(PIECE):
                    pass


def counts_of(shape: Sequence[int], chunks: Sequence[int]) -> list[int]:
    """Return how many chunks an array has along each axis."""
    return [-(-size // chunk) for size, chunk in zip(shape, chunks)]


def array_shards(array: Any) -> tuple[int, ...] | None:
    """Return the shape of an array's shards; None if it has none. Those of zarr 2 have none."""
    return getattr(array, "shards", None)


def array_version(array: Any) -> int:
    """Return the Zarr format of an array, 2 or 3. Arrays of zarr 2 have no such metadata."""
    return getattr(getattr(array, "metadata", None), "zarr_format", 2)


def _codecs_of(about: Any) -> Iterator[str]:
    """Yield the names of all codecs in the metadata of an array, also of those within others."""
    if isinstance(about, dict):
        for key in ("compressor", "filters", "codecs", "index_codecs"):
            listed: Any = about.get(key) or ()
            for codec in listed if isinstance(listed, list) else (listed,) if listed else ():
                stated = codec if isinstance(codec, dict) else {"name": codec}
                name = stated.get("id", stated.get("name"))
                yield str(name).removeprefix("numcodecs.")
                yield from _codecs_of(stated.get("configuration"))
