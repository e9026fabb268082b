"""Files of one array behind a header: NRRD, MetaImage, NIfTI and its kin, MRC.

NRRD is read with pynrrd, MetaImage with SimpleITK. Both open whatever data file a header names:
names are checked before. Coordinates of NRRD are those of the file's own space (LPS, RAS, ...).
SimpleITK turns them all to LPS, takes spacings by axis mins and maxs for 1, and refuses bzip2, an
axis of time, and spacings beside a space; and of MetaImage, which is LPS, it takes a torn zlib
stream for data, so the stream is checked here.

NIfTI, FreeSurfer and Analyze are read with nibabel: RAS. Analyze states sizes and spacing only, and
not which side is left; a pair ``.hdr`` and ``.img`` of NIfTI states all. MRC and CCP4 maps are read
with mrcfile: lengths are in angstrom, values are densities.
"""

from __future__ import annotations

import re
import zlib
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError, GridError
from ..formats import check_beside, split_header
from . import DENSITY, LABELS, Index, Names, Request, Volume, from_affine, kept_of, one_unit, triple

SPACES = dict.fromkeys(("right-anterior-superior", "ras"), "RAS")
SPACES |= dict.fromkeys(("left-posterior-superior", "lps"), "LPS")
# Fields in one spelling of those that the format allows
SPELT = {"centers": "centerings", "axismins": "axis mins", "axismaxs": "axis maxs"}
# What a MetaImage file may state: that data is a zlib stream, which byte of a number is first
NEEDED = re.compile(rb"^ *(NDims|DimSize|ElementType) *[=:] *(?:\d|MET_)", re.M)
TRUE = re.compile(rb"^ *(CompressedData|\w+ByteOrderMSB) *[=:] *[Tt1]", re.M)
UNITS = {1: "metre", 3: "micrometre"}  # of lengths in NIfTI, but for millimetres
INTENT_LABEL = 1002
VOLUME_STACKS = 401  # space groups of MRC from here on are of stacks of volumes


def read_nrrd(request: Request) -> Volume:
    """Read a ``.nrrd`` file, or a ``.nhdr`` file and the data files that it names."""
    import nrrd

    path, (text, entry, start) = request.path, split_header(request.path)
    files = _named_files(path, entry, start)
    # pynrrd reads no lists: of several files it gets the header without them
    raw = nrrd.read_header(text.splitlines(True) if len(files) > 1 else str(path))
    header = {SPELT.get(name, name): value for name, value in raw.items()}
    sizes = tuple(int(size) for size in header["sizes"])
    directions = header.get("space directions")
    along = np.nan_to_num(np.empty((0, 3)) if directions is None else np.asarray(directions, float))
    axes = np.flatnonzero((along != 0).any(1))
    index = request.pick(sizes, axes.tolist() if len(axes) == 3 else None)
    layer = next((at for at in index if not isinstance(at, slice)), 0)

    def load(index: Index) -> Any:
        if len(files) < 2:
            return nrrd.read(str(path))[0][index]
        each = {**raw, "sizes": np.array([*sizes[:-1], sizes[-1] // len(files)])}
        named = ({**each, "data file": str(file.absolute())} for file in files)
        parts = [nrrd.read_data(part, None, str(path)) for part in named]
        return np.concatenate(parts, axis=-1)[index]

    return Volume(
        *(load, sizes, nrrd.reader._determine_datatype(raw)),
        **_place(header, kept_of(index)),
        index=index,
        space=SPACES.get(str(header.get("space", "")).lower()),
        hint=LABELS if "Segment0_LabelValue" in raw else "",
        names=_segments(raw, layer),
    )


def _named_files(path: Path, entry: str, start: int) -> list[Path]:
    """Return the data files that a header names: one, ``NAME%03d.raw 1 20 1``, or a list."""
    names = [entry] * (entry.upper() not in ("", "LOCAL"))
    if entry.upper().startswith("LIST"):
        lines = path.read_bytes()[start:].decode(errors="surrogateescape").splitlines()
        names = [line.strip() for line in lines if line.strip()]
    elif "%" in entry:
        pattern, first, last, *step = entry.split()
        names = [pattern % n for n in range(int(first), int(last) + 1, *map(int, step[:1]))]
    return [check_beside(path, name) for name in names]


def _segments(raw: dict[str, Any], layer: int) -> Names:
    """Return the labels that 3D Slicer names in a ``.seg.nrrd``, those of a layer of several."""
    names: Names = {}
    for number in range(len(raw)):
        label, name, colour, at = (
            str(raw.get(f"Segment{number}_{key}", ""))
            for key in ("LabelValue", "Name", "Color", "Layer")
        )
        if label and name and int(at or 0) == layer:
            rgb = [round(255 * float(share)) for share in colour.split()]
            names[int(label)] = name, (rgb[0], rgb[1], rgb[2]) if len(rgb) == 3 else None
    return names


def _place(header: dict[str, Any], space: list[int]) -> dict[str, Any]:
    """Return what a ``Volume`` says of the place of the axes in space, as far as it is stated."""

    def of_axes(name: str, default: Any) -> Any:
        said = header.get(name, ())
        said = said.split() if isinstance(said, str) else said  # pynrrd does not split some
        return [said[axis] for axis in space] if len(said) > max(space) else [default] * 3

    origin, units = header.get("space origin"), header.get("space units")
    place: dict[str, Any] = {}
    if header.get("space directions") is not None:
        place = from_affine(np.asarray(header["space directions"], np.float64)[space, :3].T)
    else:
        names = ("spacings", "axis mins", "axis maxs")
        steps, low, high = (np.array(of_axes(name, np.nan), float) for name in names)
        # what is not stated is a cell, as for ITK and teem: its first sample is half a step further
        is_cell = np.array([each != "node" for each in of_axes("centerings", "cell")])
        counts = np.maximum(np.asarray(header["sizes"])[space] - ~is_cell, 1)
        steps = np.where(np.isfinite(steps), steps, (high - low) / counts)
        if (np.isfinite(steps) & (steps != 0)).all():
            place = from_affine(np.diag(steps))
            units = units or of_axes("units", "")
            low = low + np.where(is_cell, steps / 2, 0)
            origin = low if origin is None else origin  # which holds beside ``spacings``, too
    is_one, notes = one_unit([unit.strip('"') for unit in (units or [])[:3]])
    if not is_one:
        return {"notes": notes}
    if origin is not None and np.isfinite(origin[:3]).all():
        place["origin"] = triple(origin[:3])
    return {**place, "notes": notes}


def read_metaimage(request: Request) -> Volume:
    """Read a ``.mha`` file, or a ``.mhd`` file and the data files that it names."""
    import SimpleITK

    path, (text, entry, start) = request.path, split_header(request.path)
    if not start or len(set(NEEDED.findall(text))) < 3:
        said = "NDims, DimSize, ElementType or ElementDataFile is missing"
        raise FileError(f"its header is damaged: {said}")
    files = _named_files(path, entry, start)
    data, start = (files[0], 0) if files else (path, start)
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("MetaImageIO")
    reader.ReadImageInformation()
    size = reader.GetSize()
    if (components := reader.GetNumberOfComponents()) != 1:
        raise GridError(f"{path} has {components} numbers a sample: give a file of three axes")
    one = SimpleITK.Image([1] * len(size), reader.GetPixelID())
    dtype = SimpleITK.GetArrayViewFromImage(one).dtype
    promised = prod(size) * dtype.itemsize
    true = set(TRUE.findall(text))

    def load(index: Index) -> Any:
        if b"CompressedData" in true and len(files) < 2:
            unpacker = zlib.decompressobj()
            numbers = unpacker.decompress(data.read_bytes()[start:], promised + 1)
            if len(numbers) == promised and unpacker.eof:
                kind = dtype.newbyteorder(">" if len(true) > 1 else "<")
                return np.frombuffer(numbers, kind).reshape(size[::-1]).T[index]
        elif data.stat().st_size - start >= promised or len(files) > 1:
            return SimpleITK.GetArrayFromImage(reader.Execute()).T[index]
        raise FileError(f"{data} is truncated or damaged: {promised:,} bytes are promised")

    index = request.pick(size)
    kept = kept_of(index)
    steps, origin = (np.array(said)[kept] for said in (reader.GetSpacing(), reader.GetOrigin()))
    direction = np.array(reader.GetDirection()).reshape(len(size), -1)[np.ix_(kept, kept)]
    place = triple(np.abs(steps)), triple(origin), direction * np.sign(steps)
    return Volume(load, size, dtype, *place, index, space="LPS")


def read_nifti(request: Request) -> Volume:
    """Read a NIfTI file or pair, a file of FreeSurfer, or the ``.hdr`` of Analyze.

    The affine is nibabel's: of NIfTI the sform if there is one, else the qform. Without both, and
    of Analyze, the axes of the array are x, y and z, as ITK and method 1 of the standard have it;
    nibabel mirrors x. Values are scaled by the slope and intercept of the header.
    """
    import nibabel

    image: Any = nibabel.load(request.path, mmap=False)
    proxy, shape, header = image.dataobj, image.shape, image.header
    place: dict[str, Any] = {"index": request.pick(shape, kept=(0, 1, 2))}
    is_placed = isinstance(image, nibabel.MGHImage)
    if "xyzt_units" in header:
        is_placed = any(int(header[code]) for code in ("sform_code", "qform_code"))
        place["notes"] = one_unit([UNITS.get(int(header["xyzt_units"]) & 7, "")])[1]
        place["hint"] = LABELS if int(header["intent_code"]) == INTENT_LABEL else ""
    if is_placed:
        place |= {**from_affine(header.get_best_affine()), "space": "RAS"}
    else:
        place["spacing"] = triple(np.abs(header.get_zooms()[:3]))
    dtype = np.asarray(proxy[(slice(0, 1),) * len(shape)]).dtype
    return Volume(lambda at: proxy[at], shape, dtype, **place)


read_mgh = read_analyze = read_nifti


def read_mrc(request: Request) -> Volume:
    """Read a ``.mrc``, ``.map``, ``.rec`` or ``.ccp4`` file, or one that is packed with gzip.

    Columns, rows and sections run along the world's axes in the order of ``mapc``, ``mapr`` and
    ``maps``. The origin is the field of this name, in angstrom; if it is 0 the place of the first
    sample in the unit cell, in samples.
    """
    import mrcfile
    from mrcfile.utils import data_dtype_from_header

    with mrcfile.open(request.path, permissive=True, header_only=True) as opened:
        header = opened.header
    sizes = tuple(int(header[f"n{axis}"]) for axis in "zyx")
    order = [int(header[name]) - 1 for name in ("maps", "mapr", "mapc")]
    order = [2, 1, 0] if order == [-1] * 3 else order
    cell, angles, origin = (
        np.array(header[name].tolist(), np.float64) for name in ("cella", "cellb", "origin")
    )
    if header.ispg >= VOLUME_STACKS and header.mz != header.nz:
        raise GridError(f"it is a stack of volumes of {header.mz} sections: save one of them")
    directions = _axes_of_cell(angles if angles.all() else np.full(3, 90.0))
    counts = np.array([int(header[name]) for name in ("mx", "my", "mz")])
    steps = cell / np.maximum(counts, 1)
    is_stated = bool((cell > 0).all() and (counts > 0).all())
    if not origin.any():
        origin[order] = [int(header[f"n{axis}start"]) for axis in "zyx"]
        origin = directions @ (origin * steps)

    def load(index: Index) -> Any:
        with mrcfile.open(request.path, permissive=True) as opened:
            if opened.data is None:
                raise FileError("it is truncated")
            return opened.data

    place = triple(steps[order]) if is_stated else None, triple(origin), directions[:, order]
    return Volume(load, sizes, data_dtype_from_header(header), *place, hint=DENSITY)


def _axes_of_cell(angles: Any) -> NDArray[np.float64]:
    """Return unit vectors along a, b and c of a cell, in columns: a along x, b with y (PDB)."""
    alpha, beta, gamma = np.cos(np.radians(angles)).round(12)
    height = np.sqrt(1 - gamma**2)
    x, y = beta, (alpha - beta * gamma) / height
    return np.array([[1, 0, 0], [gamma, height, 0], [x, y, np.sqrt(1 - x**2 - y**2)]]).T
