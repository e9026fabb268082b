"""Extreme scales: values, spacings, origins and offsets from 1e-320 to 1e308, in each format."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from super_sdf.options import MESH_FORMATS

from .case import Case, ball, batch, npy, npz, upsample

VALUES = [
    *(1e-320, 1e-310, 1e-300, 1e-200, 1e-100, 1e-46, 1e-45, 1e-44, 1e-40, 1e-38, 1e-37, 1e-30),
    *(1e-20, 1e-10, 1e-7, 5e-6, 1e-5, 1e-3, 1e3, 1e5, 1e7, 1e10, 1e17, 1e20, 1e30, 1e37, 1e38),
    *(3e38, 4e38, 1e39, 1e45, 1e100, 1e154, 1e200, 1e300, 1e307, 1e308),
]
SPACINGS = [
    *("1e-320", "1e-300", "1e-100", "1e-45", "1e-20", "1e-6", "1e6", "1e30", "1e38", "1e100"),
    "1e308",
]
ORIGINS = [
    *("1e3", "5.4e6", "-5e5", "1e9", "1e12", "1e17", "1e30", "1e38", "1e39", "1e100", "1e308"),
    "-1e308",
]
OFFSETS = ["0.001", "0.5", "-0.5", "1.5", "-1.5", "3", "-3", "3.59", "5", "9", "20", "1e-9"]


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    del seed
    for value in VALUES:
        with np.errstate(all="ignore"):
            files = {"in.npy": npy(ball().astype(float) * value)}
            single = {"in.npy": npy((ball().astype(float) * value).astype(np.float32))}
        given = ("--spacing", repr(value))
        yield upsample(f"scales/inferred-{value}", files, "--json")
        yield upsample(f"scales/given-{value}", files, *given)
        yield upsample(f"scales/single-{value}", single, *given, "--factor", "2")
        yield upsample(f"scales/cap-{value}", files, *given, "--cap", "--factor", "8")
        yield upsample(f"scales/offset-{value}", files, *given, "--offset", repr(value))
        yield batch(f"scales/batch-{value}", files, *given)
        for suffix in MESH_FORMATS:
            name = f"scales/{suffix}-{value}"
            yield upsample(name, files, *given, target=f"out.{suffix}")
    yield from _origins()
    yield from _mismatches()


def _origins() -> Iterator[Case]:
    for spacing in (0.01, 0.1, 1.0, 1000.0):
        files = {"in.npz": npz(values=ball() * spacing, spacing=spacing)}
        for origin in ORIGINS:
            for suffix in MESH_FORMATS[: None if spacing in (0.1, 1.0) else 3]:
                name = f"scales/{suffix}-{spacing}-at-{origin}"
                at = ("--origin", f"{origin},0,0")
                yield upsample(name, files, *at, target=f"out.{suffix}")
    near = {"in.npz": npz(values=ball(), spacing=1.0, origin=np.array([-4.2, -5.1, 1e9]))}
    yield upsample("scales/one-axis-far", near, target="out.stl")


def _mismatches() -> Iterator[Case]:
    files = {"in.npy": npy(ball())}
    for number in SPACINGS:
        yield upsample(f"scales/spacing-{number}", files, "--spacing", number)
        yield upsample(f"scales/offset-{number}-of-1", files, "--offset", number)
        yield upsample(f"scales/offset--{number}-of-1", files, "--offset", f"-{number}")
        yield upsample(f"scales/origin-{number}", files, "--origin", number, "--cap")
    mixed = ball().astype(float)
    for number, far in enumerate((1e30, 1e38, 1e39, 1e100, 1e300, 1.7e308)):
        for sign in (1, -1):
            values = mixed.copy()
            values[0, 0, 0], values[-1] = sign * far, far
            name, odd = f"scales/mixed-{number}-{sign}", {"in.npy": npy(values)}
            yield upsample(name, odd, "--spacing", "1")
            yield upsample(f"{name}-i", odd)
    for offset in OFFSETS:
        yield upsample(f"scales/at-{offset}", files, "--offset", offset)
        yield upsample(f"scales/at-{offset}-cap", files, "--offset", offset, "--cap")
        clamped = {"in.npy": npy(np.clip(ball(), -2, 2))}
        yield upsample(f"scales/at-{offset}-clamped", clamped, "--offset", offset)
        turned = {"in.npy": npy(-ball())}
        yield upsample(f"scales/at-{offset}-positive", turned, "--offset", offset)
