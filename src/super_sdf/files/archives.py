"""Compressed data, decompressed in small pieces and checked against its checksum.

Python's zipfile decompresses whatever some kilobytes of bzip2 or LZMA hold at once, which can be
gigabytes. So only the compressed bytes of a member of an ``.npz`` archive are read with it.
"""

from __future__ import annotations

import bz2
import copy
import lzma
import struct
import zipfile
import zlib
from contextlib import suppress
from typing import Any, Protocol

from ..errors import FileError
from ..grid.planes import InputFile
from .headers import Read

PIECE = 1 << 16  # compressed bytes at a time
LARGEST_DICTIONARY = 1 << 26  # bytes that the decoder may allocate for an LZMA member


class Codec(Protocol):
    """The interface of the decompressors of bz2 and lzma."""

    @property
    def eof(self) -> bool:
        """Whether the compressed data has ended, with a right checksum."""
        ...

    @property
    def unused_data(self) -> bytes:
        """What was found after the end."""
        ...

    @property
    def needs_input(self) -> bool:
        """Whether it needs more compressed bytes before it can return anything."""
        ...

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Decompress data into at most ``max_length`` bytes."""
        ...


class Stored:
    """A "decompressor" for data that is not compressed."""

    needs_input, eof, unused_data = True, False, b""

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Return the data, which is never longer than ``max_length``."""
        return data


class Deflate:
    """A decompressor for raw deflate, or with the framing of zlib or gzip: see ``zlib``."""

    def __init__(self, window: int = -zlib.MAX_WBITS) -> None:
        self._inner = zlib.decompressobj(window)

    @property
    def eof(self) -> bool:
        """Whether the compressed data has ended, with a right checksum."""
        return self._inner.eof

    @property
    def unused_data(self) -> bytes:
        """What was found after the end."""
        return self._inner.unused_data

    @property
    def needs_input(self) -> bool:
        """Whether it needs more compressed bytes before it can return anything."""
        return not self._inner.unconsumed_tail

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Decompress data into at most ``max_length`` bytes."""
        return self._inner.decompress(self._inner.unconsumed_tail + data, max_length)


def open_archive(file: InputFile) -> zipfile.ZipFile:
    """Open a zip archive, each member of which has one name in its two headers."""
    try:
        archive = zipfile.ZipFile(file.file)
        for info in archive.infolist():
            with suppress(RuntimeError, NotImplementedError):  # one that is not read may be packed
                archive.open(info).close()  # or encrypted as it likes
        return archive
    except Exception as error:  # zipfile raises over ten kinds of error on damaged fields
        raise FileError(f"{file.name} is not a readable .npz archive: {error}") from None


class Unpacker:
    """The bytes of compressed data, decompressed as they are read.

    Parameters
    ----------
    packed : callable
        Returns the next compressed bytes.
    codec : Codec
        Decompresses them.
    size : int
        How many bytes they are decompressed.
    name : str
        The name of the data in error messages.
    """

    def __init__(self, packed: Read, codec: Codec, size: int, name: str) -> None:
        self._packed, self._codec, self.left, self.name = packed, codec, size, name

    def read(self, count: int) -> bytes:
        """Return the next ``count`` bytes, or fewer at the end.

        Raises
        ------
        FileError
            If the compressed data is damaged or ends too early.
        """
        count = min(count, self.left)
        pieces = []
        while count:
            piece = self._unpack(count)
            if not piece:
                raise self._damaged(f"{self.left:,} bytes are missing")
            pieces.append(piece)
            count -= len(piece)
            self.left -= len(piece)
            self._note(piece)
        if pieces and not self.left:
            self._check_end()
        return b"".join(pieces)

    def _unpack(self, most: int) -> bytes:
        """Return at least one and at most ``most`` bytes; none at the end."""
        while not self._codec.eof:
            data, is_fed = b"", self._codec.needs_input
            try:
                if is_fed:
                    data = self._packed(min(PIECE, most))
                piece = self._codec.decompress(data, most)
            except FileError:
                raise
            except Exception as error:  # zipfile and each codec raise their own errors
                raise self._damaged(str(error)) from None
            if piece or (is_fed and not data):
                return piece
        return b""

    def _note(self, piece: bytes) -> None:
        """Take notice of bytes that were decompressed."""

    def _check_end(self) -> None:
        """Raise FileError unless the compressed data ends here, and its checksum is right."""
        if self._unpack(PIECE) or self._codec.unused_data or self._packed(1):
            raise self._damaged("it holds more than its header promises")
        if not self._codec.eof:
            raise self._damaged("its end, with the checksum, is missing")

    def _damaged(self, reason: str) -> FileError:
        return FileError(f"{self.name} is damaged: {reason}")


class Member(Unpacker):
    """A member of an archive.

    Parameters
    ----------
    archive : ZipFile
        The archive.
    info : ZipInfo
        The member's entry in the directory of the archive.
    name : str
        The name of the member in error messages.

    Raises
    ------
    FileError
        If it is encrypted, damaged, or compressed by an unknown method.
    """

    def __init__(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> None:
        if info.flag_bits & 1:
            raise FileError(f"{name} is encrypted: save it without a password")
        self.name = name
        self._expected_checksum, self._checksum = info.CRC, 0
        packed: Any = copy.copy(info)
        packed.compress_type, packed.file_size = zipfile.ZIP_STORED, info.compress_size
        packed.CRC = None  # the checksum is of the decompressed bytes
        try:
            read = archive.open(packed).read
            super().__init__(read, self._make_codec(info.compress_type, read), info.file_size, name)
        except FileError:
            raise
        except Exception as error:  # zipfile raises many kinds of error on damaged fields
            raise self._damaged(str(error)) from None

    def _make_codec(self, kind: int, packed: Read) -> Codec:
        """Return the decompressor of the member."""
        if kind == zipfile.ZIP_STORED:
            return Stored()
        if kind == zipfile.ZIP_DEFLATED:
            return Deflate()
        if kind == zipfile.ZIP_BZIP2:
            return bz2.BZ2Decompressor()
        if kind == zipfile.ZIP_LZMA:
            return self._make_lzma(packed)
        raise FileError(
            f"{self.name} is compressed by an unknown method ({kind}): use np.savez_compressed"
        )

    def _make_lzma(self, packed: Read) -> Codec:
        """Return a decompressor for LZMA; its settings precede the data."""
        head = packed(9)
        size, settings, dictionary = struct.unpack("<2xHBI", head) if len(head) == 9 else (0, 0, 0)
        if size != 5 or settings >= 225 or dictionary > LARGEST_DICTIONARY:
            raise self._damaged("its LZMA settings are invalid")
        options = {
            "id": lzma.FILTER_LZMA1,
            "dict_size": max(dictionary, 4096),
            "lc": settings % 9,
            "lp": settings // 9 % 5,
            "pb": settings // 45,
        }
        return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[options])

    def _note(self, piece: bytes) -> None:
        self._checksum = zlib.crc32(piece, self._checksum)

    def _check_end(self) -> None:
        if self._checksum != self._expected_checksum:
            raise self._damaged("its checksum is wrong")
