"""VTK image data: arrays (z, y, x) in C order, with extent, origin and direction.

The extent need not begin at 0: sample (i, j, k) of the extent is at
``origin + direction @ (spacing * (i, j, k))``. A file has pieces, each with its own extent.

Read here and not with VTK, which takes samples that no piece covers as 0, the surface, and
allocates what a damaged header asks for. VTK unpacks LZ4 alone, which Python cannot.
"""

from __future__ import annotations

import base64
import io
import lzma
import re
from dataclasses import replace
from itertools import accumulate
from math import prod
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError, seen
from ...grid.planes import InputFile
from ...errors import check_modules
from ..streams import Deflate, Read, TextValues, Unpacker, bytes_from, next_planes
from ..volume import Planes, Request, Volume, in_words_of
from .vtk import ImageLattice

PIECE, LONGEST_TAG = 1 << 20, 1 << 20  # bytes of XML
MOST_CELLS = 10**7  # of the lattice that the borders of all pieces make
LARGEST_BLOCK = 1 << 26  # bytes, of LZ4, which is unpacked block by block
LZMA_MEMORY = 1 << 27  # bytes; xz takes 65 MB at its usual setting
TYPES = {
    f"{sign}{n}": f"{sign[0].lower()}{n // 8}" for sign in ("Int", "UInt") for n in (8, 16, 32, 64)
}
TYPES |= {"Float32": "f4", "Float64": "f8"}
APPENDED = re.compile(rb"<AppendedData[^>]*>\s*_")
KINDS = ("PointData", "CellData")
MARKS = ("vtkGhostType", "vtkValidPointMask")

Attributes = dict[str, Any]
Piece = tuple[Attributes, dict[str, dict[str, Attributes]]]


def read_vti(request: Request) -> Volume:
    """Read an array of points or of cells of a ``.vti`` file: the named one, else the only one.

    What has several numbers a sample, and VTK's own marks, is read only if it is named.
    """
    file = InputFile.open(request.path)
    outline = _Outline(file)
    arrays = outline.arrays()
    scalar = [name for name in arrays if arrays[name][2] or name == request.member]
    name = request.choose(scalar or list(arrays), "array of points or cells")
    kind, name = arrays[name][:2]
    of_points = kind == KINDS[0]
    spacing = _numbers(outline.image, "Spacing", 3, 1)
    origin = _numbers(outline.image, "Origin", 3, 0)
    turn = _numbers(outline.image, "Direction", 9, np.eye(3).ravel()).reshape(3, 3)
    lattice = ImageLattice(_extent(outline.image, "WholeExtent"), spacing, origin, turn, of_points)
    parts = [_Part(file, outline, piece, (kind, name), lattice) for piece in outline.pieces]
    _check_cover(parts, lattice.shape)
    if len({part.dtype for part in parts}) > 1:
        raise FileError(f"its pieces hold {name} in several types: save it in one")

    def read(first: int, last: int) -> NDArray[Any]:
        planes = np.empty((last - first, *lattice.shape[1:]), parts[0].dtype)
        for part in parts:
            part.copy_to(planes, first)
        return planes

    volume = lattice.volume(parts[0].dtype, read)
    packed = [part.packed for part in parts if part.packed is not None]
    return replace(volume, packed=min(sum(packed), file.size) if packed else None)


class _FoundError(Exception):
    """The data at the end of a file begins."""


class _Outline:
    """What the XML of a file says, up to the data at its end.

    ``top`` and ``image`` are the attributes of the elements VTKFile and ImageData. A piece is its
    attributes, and those of its arrays by kind and name, with ``start`` and ``end`` of the text in
    each. ``appended`` is the encoding of the data at the end, and where it begins.
    """

    def __init__(self, file: InputFile) -> None:
        self.file, self.path = file, list[str]()
        self.top, self.image, self.array = Attributes(), Attributes(), Attributes()
        self.pieces: list[Piece] = []
        self.appended: tuple[str | None, int] = (None, 0)
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype
        try:
            self._parse()
        except _FoundError:
            pass
        except expat.ExpatError as error:
            raise FileError(
                f"{file.name} is no VTK image data, truncated or damaged: {error}"
            ) from None
        if self.top.get("type") != "ImageData" or not self.image:
            raise FileError(f"{file.name} is no VTK image data, or damaged")

    def arrays(self) -> dict[str, tuple[str, str, bool]]:
        """Return kind, name, and whether it has one number a sample, of each array by its name.

        That of an array of cells beside one of points of the same name begins with ``CellData/``.
        """
        by_name: dict[str, tuple[str, str, bool]] = {}
        for kind in KINDS:
            for name, array in (pair for _, arrays in self.pieces for pair in arrays[kind].items()):
                is_scalar = array.get("NumberOfComponents", "1") == "1" and name not in MARKS
                key = name if by_name.get(name, (kind,))[0] == kind else f"{kind}/{name}"
                by_name[key] = kind, name, is_scalar
        return by_name

    def _parse(self) -> None:
        for place in range(0, self.file.size, PIECE):
            text = self.file.read(place, PIECE).tobytes()
            self.parser.Parse(text, place + PIECE >= self.file.size)
            if place + len(text) - self.parser.CurrentByteIndex > LONGEST_TAG:
                raise FileError(f"{self.file.name} is damaged: a tag is too long")

    def _refuse_doctype(self, *_: Any) -> None:  # and so entities
        raise FileError(f"{self.file.name} has a document type: VTK image data has none")

    def _start(self, name: str, attributes: Attributes) -> None:
        self.path.append(name)
        match self.path:
            case ["VTKFile"]:
                self.top = attributes
            case [_, "ImageData"]:
                self.image = attributes
            case [_, "ImageData", "Piece"]:
                self.pieces.append((attributes, {kind: {} for kind in KINDS}))
            case [_, "ImageData", "Piece", ("PointData" | "CellData") as kind, "DataArray"]:
                arrays, label = self.pieces[-1][1][kind], attributes.get("Name", "")
                if label in arrays:
                    raise FileError(
                        f"{self.file.name} holds {label} twice in a piece: save one time step"
                    )
                self.array = arrays[label] = attributes | {"start": 0, "end": 0}
                self.parser.CharacterDataHandler = self._text
            case [_, "AppendedData"]:
                place = self.parser.CurrentByteIndex
                tag = APPENDED.match(self.file.read(place, LONGEST_TAG).tobytes())
                if not tag:
                    raise FileError(
                        f"{self.file.name} is damaged: its appended data does not begin with _"
                    )
                self.appended = attributes.get("encoding"), place + tag.end()
                raise _FoundError

    def _text(self, text: str) -> None:
        if text.strip() and self.path[-1] == "DataArray":
            place = self.parser.CurrentByteIndex
            self.array["start"] = place + len(text) - len(text.lstrip())
            self.parser.CharacterDataHandler = None

    def _end(self, name: str) -> None:
        if name == "DataArray":
            self.array["end"] = self.parser.CurrentByteIndex
            self.parser.CharacterDataHandler = None
        self.path.pop()


class _Source:
    """Bytes between two places in a file, as they are or in base64."""

    def __init__(self, file: InputFile, start: int, end: int, is_text: bool) -> None:
        self.file, self.start, self.end, self.is_text = file, start, end, is_text
        self.size = max(end - start, 0)
        if is_text:
            self.size = self.size // 4 * 3

    def read(self, offset: int, count: int) -> NDArray[np.uint8]:
        if not self.is_text:
            place = self.start + offset
            return self.file.read(place, min(count, self.end - place))
        first, last = offset // 3, -(-(offset + count) // 3)
        place, stop = self.start + 4 * first, min(self.start + 4 * last, self.end)
        text = self.file.read(place, stop - place).tobytes()
        data = base64.b64decode(text.rstrip() if stop == self.end else text, validate=True)
        return np.frombuffer(data, np.uint8)[offset - 3 * first :][:count]

    def after(self, size: int) -> _Source:
        text = -(-size // 3) * 4 if self.is_text else size
        return _Source(self.file, self.start + text, self.end, self.is_text)


class _Part:
    """An array of a piece, whose planes come in order, and where it is in the whole array.

    ``low`` and ``high`` are its first sample along each axis (z, y, x), and that after its last;
    ``packed`` is the size of compressed data.
    """

    packed: int | None = None

    def __init__(
        self,
        file: InputFile,
        outline: _Outline,
        piece: Piece,
        which: tuple[str, str],
        lattice: ImageLattice,
    ) -> None:
        extent = _extent(piece[0], "Extent")
        self.shape = replace(lattice, extent=extent).shape
        self.low = tuple(extent[2 * axis] - lattice.extent[2 * axis] for axis in (2, 1, 0))
        self.high = tuple(low + size for low, size in zip(self.low, self.shape))
        kind, name = which
        array, self.name = piece[1][kind].get(name), f"{file.name}:{name}"
        inside = all(a >= 0 and b <= n for a, b, n in zip(self.low, self.high, lattice.shape))
        if array is None or not inside:
            reason = "is not in the whole extent" if array else f"has no {name}"
            raise FileError(f"{file.name} is damaged: its piece {seen(extent)} {reason}")
        if array.get("NumberOfComponents", "1") != "1" or array.get("type") not in TYPES:
            raise GridError(f"{self.name} is no array of one number per sample")
        order = {"LittleEndian": "<", "BigEndian": ">"}[outline.top.get("byte_order", "")]
        self.dtype = np.dtype(order + TYPES[array["type"]])
        self.word = np.dtype(order + ("u8" if outline.top.get("header_type") == "UInt64" else "u4"))
        self.planes = self._planes(file, outline, array)

    def copy_to(self, planes: NDArray[Any], first: int) -> None:
        start, stop = max(self.low[0], first), min(self.high[0], first + len(planes))
        if start < stop:
            _, rows, columns = (slice(*ends) for ends in zip(self.low, self.high))
            part = self.planes(start - self.low[0], stop - self.low[0])
            planes[start - first : stop - first, rows, columns] = part

    def _planes(self, file: InputFile, outline: _Outline, array: Attributes) -> Planes:
        if array.get("format") == "ascii":
            return TextValues(file, array["start"], array["end"], self.dtype, self.shape).planes
        source = _Source(file, array["start"], array["end"], True)
        if array.get("format") == "appended":
            encoding, start = outline.appended
            offset = array.get("offset", "").strip()
            if encoding not in ("raw", "base64") or not re.fullmatch("[0-9]{1,18}", offset):
                raise FileError(f"{self.name} is damaged: its offset is {seen(offset)}")
            source = _Source(file, start + int(offset), file.size, encoding == "base64")
        compressor = outline.top.get("compressor")
        read = self._blocks(source, compressor) if compressor else self._whole(source)
        return next_planes(read, self.shape, self.dtype)

    def _words(self, source: _Source, first: int, count: int) -> list[int]:
        size = self.word.itemsize
        if (first + count) * size > source.size:
            raise FileError(f"{self.name} is truncated: its data begins after the end of the file")
        data = source.read(first * size, count * size)
        return [int(number) for number in data.view(self.word)]

    def _whole(self, source: _Source) -> Read:
        (size,) = self._words(source, 0, 1)
        start = self.word.itemsize
        self._check_size(size)
        if source.size < start + size:
            raise FileError(
                f"{self.name} is truncated: {size:,} bytes are promised, {source.size:,} follow"
            )
        return bytes_from(source, start, start + size)

    def _check_size(self, size: int) -> None:
        if size != prod(self.shape) * self.dtype.itemsize:
            promised = in_words_of(self.shape, self.dtype)
            raise FileError(f"{self.name} is damaged: {size:,} bytes for {promised}")

    def _blocks(self, source: _Source, compressor: str) -> Read:
        """Return a function that reads compressed data: blocks of one size, the last shorter."""
        count, size, last = self._words(source, 0, 3)
        sizes = [size] * (count - 1) + [last or size] if count < source.size else []
        self._check_size(sum(sizes))
        packed = self._words(source, 3, count)
        self.packed = sum(packed)
        data = source.after((3 + count) * self.word.itemsize)
        starts = [0, *accumulate(packed)]
        blocks = (
            _block(compressor, bytes_from(data, start, start + length), length, whole, self.name)
            for start, length, whole in zip(starts, packed, sizes)
        )
        block = next(blocks)

        def read(count: int) -> bytes:
            nonlocal block
            pieces = []
            while count:
                piece = block(count)
                if not piece:
                    block = next(blocks)
                pieces.append(piece)
                count -= len(piece)
            return b"".join(pieces)

        return read


def _block(compressor: str, packed: Read, length: int, size: int, name: str) -> Read:
    """Return a function that reads a block of some bytes, of which ``length`` are stored."""
    if compressor == "vtkZLibDataCompressor":
        return Unpacker(packed, Deflate(), size, name).read
    if compressor == "vtkLZMADataCompressor":
        return Unpacker(packed, lzma.LZMADecompressor(memlimit=LZMA_MEMORY), size, name).read
    if compressor != "vtkLZ4DataCompressor" or max(size, length) > LARGEST_BLOCK:
        raise FileError(
            f"its compressor is {seen(compressor)}, a block {size:,} bytes: save it with "
            "vtkZLibDataCompressor"
        )
    check_modules("LZ4 in VTK image data", "vti")
    from vtkmodules.vtkIOCore import vtkLZ4DataCompressor

    data, block, unpacker = packed(length), np.empty(size, np.uint8), vtkLZ4DataCompressor()
    if unpacker.Uncompress(data, len(data), block, size) != size:  # type: ignore[call-overload]
        raise FileError(f"{name} is damaged: a block of LZ4 does not have {size:,} bytes")
    return io.BytesIO(block.tobytes()).read


def _check_cover(parts: list[_Part], shape: tuple[int, ...]) -> None:
    """Raise FileError if some samples are in no piece: VTK has 0 there, which is the surface."""
    cuts = [sorted({end for p in parts for end in (p.low[a], p.high[a])}) for a in range(3)]
    if prod(map(len, cuts)) > MOST_CELLS:
        raise FileError(f"its {len(parts):,} pieces are too many, or lie anyhow: save it as one")
    covered = np.zeros([max(len(cut) - 1, 0) for cut in cuts], bool)
    for part in parts:
        ends = (cut.index(end) for cut, both in zip(cuts, zip(part.low, part.high)) for end in both)
        a, b, c, d, e, f = ends
        covered[a:b, c:d, e:f] = True
    lengths = [np.diff(cut).astype(object) for cut in cuts]
    counts = np.multiply.outer(np.multiply.outer(lengths[0], lengths[1]), lengths[2])
    missing = prod(shape) - int(counts[covered].sum() if covered.any() else 0)
    if missing:
        raise FileError(
            f"{missing:,} of its {prod(shape):,} samples are in no piece: save it with all pieces"
        )


def _extent(attributes: Attributes, name: str) -> tuple[int, ...]:
    words = attributes.get(name, "").split()
    if len(words) != 6 or not all(re.fullmatch("-?[0-9]{1,10}", word) for word in words):
        raise FileError(f"its {name} is {seen(attributes.get(name))}: give six whole numbers")
    return tuple(map(int, words))


def _numbers(attributes: Attributes, name: str, count: int, default: Any) -> NDArray[np.float64]:
    if name not in attributes:
        return np.broadcast_to(np.asarray(default, np.float64), count)
    numbers = np.array(attributes[name].split(), np.float64)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise FileError(f"its {name} is {seen(attributes[name])}: give {count} numbers")
    return numbers
