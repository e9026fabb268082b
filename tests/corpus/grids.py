"""``.npy`` files: odd and damaged headers, every dtype in every order, odd shapes."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from .case import Case, ball, batch, mutate, npy, npz, rng_of, upsample

DTYPES = "?bBhHiIlLqQefdgFDGSUOMmV"
SHAPES = [
    *("()", "(12,)", "(12, 12)", "(12, 12, 12, 1)", "(1728,)", "12", "[12, 12, 12]", "None"),
    *("(-1, 12, 12)", "(-12, -12, -12)", "(0, 12, 12)", "(True, 12, 12)", "(12L, 12L, 12L)"),
    *("(12.0, 12, 12)", "(9999999999999999999999, 12, 12)", "(4294967296, 4294967296, 1)"),
    *("(9223372036854775807, 9223372036854775807, 1)", "(1000000, 1000000, 1000000)"),
    *("(2, 2, 100000)", "('12', 12, 12)", "(12, 12, 12", "12, 12, 12)", "((12, 12), 12)"),
    *("(12, 12, 12j)", "(0x0c, 0o14, 12)", "(1" + "0" * 5000 + ", 2, 2)", "{12}"),
    *("(" * 300 + "12" + ")" * 300, "(" * 9000 + "12" + ")" * 9000),
]
DESCRS = [
    *("'<f4 '", "'f4'", "'|f4'", "'>f4'", "'<f16'", "'<f0'", "'<f3'", "''", "'|O'", "'|b1'"),
    *("'<f99999999999999999999'", "'<U12'", "'|S4'", "'|V0'", "'<M8[s]'", "'<M8[zz]'", "'<c8'"),
    *("[('a', '<f4')]", "[('a', '<f4'), ('a', '<f4')]", "[]", "[('', '|V0')]", "None", "4"),
    *("('<f4', (99999999,))", "{'names': ['a']}", "'<f4,<f4'", "'(99999999999,)f4'"),
    *("[('a', 'O')]", "'a'*99999", "'\\x00'", "'<é4'", "[('a'," * 200 + "'<f4'" + ")]" * 200),
]
SAID = "{'descr': '<f4', 'fortran_order': False, 'shape': (12, 12, 12)"
WHOLE = [
    *("", " ", "{", "}", "{}", "[]", "()", "1", "None", "{'descr': '<f4'}", "'" * 3, "\\", "#"),
    *(
        "\x00" * 64,
        "\xff" * 64,
        "\x0c{}",
        SAID,
        SAID + "}" + " " * 20000,
        SAID + "} {}",
        "  " + SAID,
    ),
    *(SAID + ", 'more': 1}", SAID + ", 'shape': (2, 2, 2)}", SAID + "}\n\t x", "-" * 5000 + "1"),
    *(SAID.replace("False", order) + ", }" for order in ("0", "'no'", "None")),
    *(SAID + ", 'a': " + "[" * 9999 + "}", "{" * 200 + "}" * 200),
    "__import__('os').system('touch made')",
    SAID.replace("12, 12, 12", "1+" * 4000 + "1, 12, 12") + "}",
]
SIZES = [
    *((2, 2, 2), (1, 12, 12), (12, 1, 12), (12, 12, 1), (1, 1, 1), (0, 0, 0), (0, 2, 2)),
    *((2, 2, 64), (64, 2, 2), (2, 64, 2), (3, 3, 3), (3, 2, 3), (2, 12, 12), (12, 2, 12)),
    *((12, 12, 2), (3, 3, 400), (400, 3, 3), (3, 400, 3), (2, 2, 3000), (5, 7, 90), (4, 4, 4)),
    *((1, 9, 9, 9), (9, 9, 9, 1), (9, 9), (81,), (), (2,) * 8, (1, 1, 1, 9, 9, 9), (6, 5, 4)),
]


def header(text: str, version: tuple[int, int] = (1, 0), data: bytes | None = None) -> bytes:
    """Return an .npy file with a header as given, and the data of a ball."""
    raw = text.encode("utf-8" if version == (3, 0) else "latin-1", "replace")
    length = struct.pack("<H", min(len(raw), 65535)) if version[0] == 1 else None
    length = length or struct.pack("<I", len(raw))
    body = ball().tobytes() if data is None else data
    return b"\x93NUMPY" + bytes(version) + length + raw + body


def said(descr: str = "'<f4'", order: str = "False", shape: str = "(12, 12, 12)") -> str:
    """Return the text of a header."""
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n"


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    texts = [said(shape=shape) for shape in SHAPES] + [said(descr) for descr in DESCRS] + WHOLE
    for number, text in enumerate(texts):
        for version in [(1, 0), (2, 0), (3, 0), (9, 9)][: 4 if number % 5 == 0 else 2]:
            name = f"grids/header-{number}-v{version[0]}"
            yield upsample(name, {"in.npy": header(text, version)}, alone=len(text) > 8000)
        if number % 3 == 0:
            yield batch(f"grids/batch-header-{number}", {"in.npy": header(text)})
    yield from _damaged(seed)
    yield from _dtypes()
    yield from _shapes()


def _damaged(seed: int) -> Iterator[Case]:
    whole = npy(ball())
    for number in range(420):
        name = f"grids/damaged-{number}"
        last = 140 if number % 3 else None
        data = mutate(whole, rng_of(name, seed), 0, last)
        yield (batch if number % 7 == 0 else upsample)(name, {"in.npy": data})
    for number in range(80):
        name = f"grids/truncated-{number}"
        end = int(rng_of(name, seed).integers(0, 200 if number % 2 else len(whole)))
        yield upsample(name, {"in.npy": whole[:end]})
    for number, length in enumerate([0, 1, 117, 119, 65535]):
        data = whole[:8] + struct.pack("<H", length) + whole[10:]
        yield upsample(f"grids/header-length-{number}", {"in.npy": data})
    for number, data in enumerate([b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00", b"PK\x03\x04", b"\n"]):
        yield upsample(f"grids/start-{number}", {"in.npy": data})
    yield upsample("grids/long-tail", {"in.npy": whole + b"x" * 100_000})


def _dtypes() -> Iterator[Case]:
    for letter in DTYPES:
        for order in "<>":
            dtype = np.dtype(
                {"S": "S5", "U": "U5", "V": "V4", "M": "M8[s]", "m": "m8[s]"}.get(letter, letter)
            )
            dtype = dtype.newbyteorder(order)
            try:
                values = (ball() * 10).astype(dtype)
            except (TypeError, ValueError):
                values = np.zeros((12, 12, 12), dtype)
            for fortran in (False, True):
                array = np.asfortranarray(values) if fortran else values
                name = f"grids/dtype-{letter}-{'le' if order == '<' else 'be'}-{'fc'[not fortran]}"
                spaced = ("--spacing", "10")
                yield upsample(name, {"in.npy": npy(array)}, *spaced)
                yield upsample(f"{name}-inferred", {"in.npy": npy(array)}, "--factor", "2")
                yield upsample(f"{name}-npz", {"in.npz": npz(values=array)})
            yield batch(f"grids/batch-{letter}-{ord(order)}", {"in.npy": npy(values)}, *spaced)


def _shapes() -> Iterator[Case]:
    for number, shape in enumerate(SIZES):
        values = ball(shape) if len(shape) == 3 else np.linspace(-1, 1, int(np.prod(shape)))
        files = {"in.npy": npy(values.reshape(shape))}
        for factor in ("2", "4", "8"):
            words = ("--spacing", "1", "--factor", factor, "--inside", "negative")
            yield upsample(f"grids/shape-{number}-{factor}", files, *words)
            yield upsample(f"grids/shape-{number}-{factor}-cap", files, "--cap", "--factor", factor)
        yield batch(f"grids/shape-{number}-batch", files)
