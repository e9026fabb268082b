"""``.npz`` files whose arrays are odd: what spacing and origin may be, headers within."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .archives import WHOLE, archive
from .case import Case, ball, batch, npz, upsample
from .grids import header, said


def numbers() -> dict[str, Any]:
    """Return odd things to find as spacing or origin."""
    return {
        **{f"float-{text}": float(text) for text in ("nan", "inf", "-inf", "0", "-1", "1e308")},
        **{f"tiny-{text}": float(text) for text in ("5e-324", "1e-300", "1e-45", "1e-20")},
        "int": 1,
        "big-int": np.uint64(2**64 - 1),
        "bool": True,
        "text": "one",
        "bytes": b"1.0",
        "complex": 1 + 1j,
        "none": np.array(None),
        "empty": np.zeros(0),
        "two": np.ones(2),
        "three": np.ones(3),
        "four": np.ones(4),
        "unequal": np.array([1, 2, 3.0]),
        "nearly": np.array([1, 1.0005, 1]),
        "one-nan": np.array([1, np.nan, 1]),
        "column": np.ones((3, 1)),
        "matrix": np.eye(4),
        "date": np.datetime64("2020-01-01"),
        "structured": np.array([(1.0,)], [("h", "f8")]),
        "half": np.float16(1),
        "extended": np.longdouble("1e4000"),
        "big-endian": np.array(1.0, ">f8"),
        "fortran": np.asfortranarray(np.ones((1, 3))),
    }


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    del seed
    for key in ("spacing", "origin"):
        for name, number in numbers().items():
            files = {"in.npz": npz(**{"values": ball(), key: number})}
            yield upsample(f"members/{key}-{name}", files, "--json", source="in.npz")
            yield batch(f"members/{key}-{name}-batch", files, source="in.npz")
    for number, text in enumerate(("'<f4'", "'|O'", "", "(", "[" * 500, "'f4' 1", "0x", "\\")):
        for key in ("values", "spacing"):
            members = {**WHOLE, f"{key}.npy": header(said(text))}
            files = {"in.npz": archive(members.items())}
            yield upsample(f"members/header-{key}-{number}", files, source="in.npz")
