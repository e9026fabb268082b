"""``.npz`` files: hostile archives, odd members, damaged bytes, odd places."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .case import Case, Content, ball, batch, mutate, npy, npz, rng_of, upsample, words
from .grids import header, said

PACKED = {
    "stored": zipfile.ZIP_STORED,
    "deflate": zipfile.ZIP_DEFLATED,
    "bzip2": zipfile.ZIP_BZIP2,
    "lzma": zipfile.ZIP_LZMA,
}
WHOLE = {"values.npy": npy(ball()), "spacing.npy": npy(1.0), "origin.npy": npy(np.zeros(3))}


def archive(members: Iterable[tuple[str, bytes]], packed: int = zipfile.ZIP_STORED) -> bytes:
    """Return an archive; names may come twice."""
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", packed) as out:
        warnings.simplefilter("ignore")  # of names that come twice
        for name, data in members:
            out.writestr(zipfile.ZipInfo(name), data, packed)
    return file.getvalue()


def bomb(key: str, shape: tuple[int, ...], packed: int = zipfile.ZIP_DEFLATED) -> Content:
    """Return what makes an archive of an array that packs well and is large unpacked."""

    def write(path: Path) -> None:
        text = said(shape=repr(shape))
        size, piece = 4 * int(np.prod(shape)), bytes(1 << 20)
        with zipfile.ZipFile(path, "w", packed) as out:
            with out.open(f"{key}.npy", "w", force_zip64=True) as member:
                member.write(header(text, data=b""))
                for start in range(0, size, len(piece)):
                    member.write(piece[: size - start])
            if key != "values":
                out.writestr("values.npy", WHOLE["values.npy"])

    return write


def odd_archives() -> dict[str, bytes]:
    """Return archives that are odd as a whole, by what is odd."""
    values = WHOLE["values.npy"]
    good = archive(WHOLE.items())
    encrypted = bytearray(good)
    encrypted[6] |= 1
    middle = good.find(b"PK\x01\x02")
    encrypted[middle + 8] |= 1
    method = bytearray(good)
    method[8], method[middle + 10] = 93, 93
    bad_utf8 = bytearray(good.replace(b"origin.npy", b"\xff\xfe\xfdgin.npy"))
    for at in (i for i in range(len(good)) if good[i : i + 4] in (b"PK\x01\x02", b"PK\x03\x04")):
        bad_utf8[at + (9 if good[at + 2] == 1 else 7)] |= 8
    return {
        "empty": archive([]),
        "nothing": b"",
        "no-values": archive([("data.npy", values)]),
        "raw-name": archive([("values", values)]),
        "folder": archive([("values.npy/", b"")]),
        "within": archive([("a/values.npy", values)]),
        "above": archive([("../values.npy", values), ("values.npy", values)]),
        "absolute": archive([("/values.npy", values)]),
        "backslash": archive([("\\values.npy", values)]),
        "twice": archive([("values.npy", values), ("values.npy", npy(-ball()))]),
        "no-array": archive([("values.npy", b"hello")]),
        "nested": archive([("values.npy", good)]),
        "nul": archive([("values\0.npy", values)]),
        "many": archive([*WHOLE.items(), *((f"{i}.npy", b"") for i in range(3000))]),
        "long-name": archive([*WHOLE.items(), ("n" * 60000 + ".npy", b"")]),
        "line-break": archive([("a\nb.npy", values)]),
        "encrypted": bytes(encrypted),
        "unknown-method": bytes(method),
        "bad-utf8": bytes(bad_utf8),
        "comment": good[:-2] + struct.pack("<H", 60000) + b"c" * 60000,
        "after": good + b"x" * 1000,
        "cut": good[:-30],
        "two": good + good,
        "crc": good.replace(values[-40:], bytes(40), 1),
        "zip64": good.replace(struct.pack("<I", len(values)), b"\xff" * 4),
        "npy-inside": values,
        "strings": npz(values=np.full((3, 3, 3), "x")),
        "object-spacing": npz(values=ball(), spacing=np.array([1, None], object)),
        "other-keys": npz(values=ball(), sdf=ball(), note="hello", arr_0=1),
    }


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    for name, data in odd_archives().items():
        yield upsample(f"archives/{name}", {"in.npz": data})
        yield batch(f"archives/{name}-batch", {"in.npz": data})
    yield from _damaged(seed)
    yield from _bombs()
    yield from _members()


def _damaged(seed: int) -> Iterator[Case]:
    for packing, packed in PACKED.items():
        whole = archive(WHOLE.items(), packed)
        for number in range(110):
            name = f"archives/{packing}-{number}"
            rng = rng_of(name, seed)
            first = 0 if number % 3 else whole.find(b"PK\x01\x02")
            data = mutate(whole, rng, first, 200 if number % 3 == 1 else None)
            make = batch if number % 9 == 0 else upsample
            yield make(name, {"in.npz": data})
        for number in range(15):
            name = f"archives/{packing}-cut-{number}"
            end = int(rng_of(name, seed).integers(len(whole)))
            yield upsample(name, {"in.npz": whole[:end]})


def _bombs() -> Iterator[Case]:
    """Yield small archives of large arrays, in what they say or in what they hold."""
    huge = archive([("values.npy", header(said(shape="(3000, 3000, 3000)")))])
    yield upsample("archives/says-108-GB", {"in.npz": huge})
    for packing in ("deflate", "bzip2"):
        files = {"in.npz": bomb("values", (800, 800, 500), PACKED[packing])}
        yield upsample(f"archives/bomb-{packing}", files, "--max-memory", "500M", alone=True)
    for key in ("spacing", "origin"):
        files = {"in.npz": bomb(key, (375_000_000,))}
        yield upsample(f"archives/bomb-{key}", files, alone=True)
    yield batch("archives/bomb-batch", {"in.npz": bomb("spacing", (375_000_000,))}, alone=True)


def numbers() -> dict[str, Any]:
    """Return odd things to find as spacing or origin."""
    floats = words("nan inf -inf 0 -1 1e308 5e-324 1e-300 1e-45")
    return {
        **{f"float-{text}": float(text) for text in floats},
        **{"int": 1, "big-int": np.uint64(2**64 - 1), "bool": True, "text": "one", "bytes": b"1.0"},
        **{"complex": 1 + 1j, "none": np.array(None), "half": np.float16(1)},
        **{f"many-{count}": np.ones(count) for count in (0, 2, 3, 4)},
        "unequal": np.array([1, 2, 3.0]),
        "nearly": np.array([1, 1.0005, 1]),
        "one-nan": np.array([1, np.nan, 1]),
        "matrix": np.eye(4),
        "date": np.datetime64("2020-01-01"),
        "structured": np.array([(1.0,)], [("h", "f8")]),
        "extended": np.longdouble("1e4000"),
        "big-endian": np.array(1.0, ">f8"),
    }


def _members() -> Iterator[Case]:
    for key in ("spacing", "origin"):
        for name, number in numbers().items():
            files = {"in.npz": npz(**{"values": ball(), key: number})}
            yield upsample(f"archives/{key}-{name}", files, "--json")
            yield batch(f"archives/{key}-{name}-batch", files)
    for number, text in enumerate(("'<f4'", "'|O'", "", "(", "[" * 500, "'f4' 1", "0x", "\\")):
        for key in ("values", "spacing"):
            members = {**WHOLE, f"{key}.npy": header(said(text))}
            files = {"in.npz": archive(members.items())}
            yield upsample(f"archives/header-{key}-{number}", files)
