"""Members of ``.npz`` archives, unpacked in small pieces and checked against their sum.

Python's zipfile unpacks as much at once as some kilobytes of bzip2 or LZMA give, which can be
gigabytes. So only the packed bytes are taken from it.
"""

from __future__ import annotations

import bz2
import copy
import lzma
import struct
import zipfile
import zlib
from typing import Any, Protocol

from ..errors import FileError

PIECE = 1 << 16  # packed bytes at a time
LARGEST_DICTIONARY = 1 << 26  # bytes that an LZMA member may make the decoder take


class Codec(Protocol):
    """A decompressor as those of bz2 and lzma."""

    @property
    def needs_input(self) -> bool:
        """Whether it has given all that it can."""
        ...

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Take packed bytes and return at most ``max_length`` unpacked ones."""
        ...


class Stored:
    """What is not compressed."""

    needs_input = True

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Return the data: no more is given than is asked for."""
        return data


class Deflate:
    """Raw deflate."""

    def __init__(self) -> None:
        self._inner = zlib.decompressobj(-zlib.MAX_WBITS)

    @property
    def needs_input(self) -> bool:
        """Whether it has given all that it can."""
        return not self._inner.unconsumed_tail

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Take packed bytes and return at most ``max_length`` unpacked ones."""
        return self._inner.decompress(self._inner.unconsumed_tail + data, max_length)


class Member:
    """A member of an archive, unpacked as it is read.

    Parameters
    ----------
    archive : ZipFile
        The archive.
    info : ZipInfo
        What its directory says of the member.
    name : str
        What errors call it.
    """

    def __init__(self, archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> None:
        if info.flag_bits & 1:
            raise FileError(f"{name} is encrypted: save it without a password")
        self.name, self.left = name, info.file_size
        self._wanted_sum, self._sum = info.CRC, 0
        packed: Any = copy.copy(info)
        packed.compress_type, packed.file_size = zipfile.ZIP_STORED, info.compress_size
        packed.CRC = None  # that of the unpacked bytes
        try:
            self._packed = archive.open(packed)
            self._codec = self._make_codec(info.compress_type)
        except FileError:
            raise
        except Exception as error:  # zipfile raises what a wrong field leads to
            raise self._damaged(str(error)) from None

    def _make_codec(self, kind: int) -> Codec:
        """Return what unpacks the member."""
        if kind == zipfile.ZIP_STORED:
            return Stored()
        if kind == zipfile.ZIP_DEFLATED:
            return Deflate()
        if kind == zipfile.ZIP_BZIP2:
            return bz2.BZ2Decompressor()
        if kind == zipfile.ZIP_LZMA:
            return self._make_lzma()
        raise FileError(
            f"{self.name} is compressed in an unknown way ({kind}): use np.savez_compressed"
        )

    def _make_lzma(self) -> Codec:
        """Return what unpacks LZMA, whose settings stand before the data."""
        head = self._packed.read(9)
        size, settings, dictionary = struct.unpack("<2xHBI", head) if len(head) == 9 else (0, 0, 0)
        if size != 5 or settings >= 225 or dictionary > LARGEST_DICTIONARY:
            raise self._damaged("its LZMA settings make no sense")
        options = {
            "id": lzma.FILTER_LZMA1,
            "dict_size": max(dictionary, 4096),
            "lc": settings % 9,
            "lp": settings // 9 % 5,
            "pb": settings // 45,
        }
        return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[options])

    def read(self, count: int) -> bytes:
        """Return the next bytes, as many as asked for, fewer only at the end.

        Raises
        ------
        FileError
            If the packed data is damaged, or ends too early.
        """
        count = min(count, self.left)
        pieces = []
        while count:
            piece = self._unpack(count)
            pieces.append(piece)
            count -= len(piece)
            self.left -= len(piece)
            self._sum = zlib.crc32(piece, self._sum)
        if pieces and not self.left and self._sum != self._wanted_sum:
            raise self._damaged("its check sum differs")
        return b"".join(pieces)

    def _unpack(self, most: int) -> bytes:
        """Return some bytes."""
        while True:
            data = b""
            try:
                if self._codec.needs_input:
                    data = self._packed.read(min(PIECE, most))
                piece = self._codec.decompress(data, most)
            except Exception as error:  # zipfile and each way to compress have errors of their own
                raise self._damaged(str(error)) from None
            if piece:
                return piece
            if not data and self._codec.needs_input:
                raise self._damaged(f"{self.left:,} bytes are missing")

    def _damaged(self, reason: str) -> FileError:
        return FileError(f"{self.name} is damaged: {reason}")
