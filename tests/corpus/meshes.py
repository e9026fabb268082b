"""Meshes for ``sample``: damaged, empty, flat, open, odd in scale."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import numpy as np

from .case import Case, mutate, rng_of, sample

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def ply(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as text PLY."""
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, map(float, v))) for v in vertices]
    rows += [f"{len(f)} " + " ".join(str(int(i)) for i in f) for f in faces]
    return (head + "\n".join(rows) + "\n").encode()


def binary_ply(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as binary PLY."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = b"".join(struct.pack("<B3i", 3, *map(int, face)) for face in faces)
    return head.encode() + vertices.astype("<f4").tobytes() + rows


def stl(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as binary STL."""
    rows = b"".join(bytes(12) + vertices[f].astype("<f4").tobytes() + bytes(2) for f in faces)
    return b"corpus".ljust(80) + struct.pack("<I", len(faces)) + rows


def obj(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as OBJ."""
    rows = ["v " + " ".join(map(repr, map(float, v))) for v in vertices]
    rows += ["f " + " ".join(str(int(i) + 1) for i in f) for f in faces]
    return "\n".join(rows).encode()


def off(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as OFF."""
    rows = [f"OFF\n{len(vertices)} {len(faces)} 0"]
    rows += [" ".join(map(repr, map(float, v))) for v in vertices]
    rows += [f"{len(f)} " + " ".join(str(int(i)) for i in f) for f in faces]
    return "\n".join(rows).encode()


WRITERS: dict[str, Callable[..., bytes]] = {"ply": ply, "stl": stl, "obj": obj, "off": off}
CUBE = {"cube.ply": ply()}


def odd_meshes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return meshes that bound no solid, or an odd one."""
    changed = {}
    for text in ("nan", "inf", "1e30", "1e38", "1e39", "1e200", "1e308", "-1e308"):
        vertices = CORNERS.copy()
        vertices[3, 1] = float(text)
        changed[f"one-{text}"] = (vertices, FACES)
    for text in ("1e-320", "1e-300", "1e-160", "1e-100", "1e-46", "1e-20", "1e-9", "0", "-1"):
        changed[f"times-{text}"] = (CORNERS * float(text), FACES)
    for text in ("1e9", "1e20", "1e38", "1e100", "1e154", "1e155", "1e200", "1e300", "1e308"):
        changed[f"times-{text}"] = (CORNERS * float(text), FACES)
        changed[f"at-{text}"] = (CORNERS + float(text), FACES)
    bad = {"beyond": 8, "far-beyond": 2**31 - 1, "negative": -1, "wrapped": -(2**31)}
    for what, index in bad.items():
        faces = FACES.copy()
        faces[5, 1] = index
        changed[what] = (CORNERS, faces)
    return changed | {
        "no-faces": (CORNERS, FACES[:0]),
        "nothing": (CORNERS[:0], FACES[:0]),
        "no-vertices": (CORNERS[:0], FACES),
        "one-triangle": (CORNERS, FACES[:1]),
        "open": (CORNERS, FACES[:-1]),
        "inverted": (CORNERS, FACES[:, ::-1]),
        "one-turned": (CORNERS, np.concatenate([FACES[:1, ::-1], FACES[1:]])),
        "twice": (CORNERS, np.concatenate([FACES, FACES])),
        "both-ways": (CORNERS, np.concatenate([FACES, FACES[:, ::-1]])),
        "flat": (CORNERS * [1, 1, 0], FACES),
        "nearly-flat": (CORNERS * [1, 1, 1e-12], FACES),
        "line": (CORNERS * [1, 0, 0], FACES),
        "needle": (CORNERS * [1e6, 1, 1], FACES),
        "points": (CORNERS, np.zeros((12, 3), int)),
        "two-cubes": (np.concatenate([CORNERS, CORNERS + 0.5]), np.concatenate([FACES, FACES + 8])),
        "far-apart": (np.concatenate([CORNERS, CORNERS + 1e9]), np.concatenate([FACES, FACES + 8])),
        "touching": (np.concatenate([CORNERS, CORNERS + 1]), np.concatenate([FACES, FACES + 8])),
        "many-points": (np.concatenate([CORNERS, np.zeros((5000, 3))]), FACES),
        "inner": (
            np.concatenate([CORNERS, CORNERS / 3 + 0.3]),
            np.concatenate([FACES, FACES[:, ::-1] + 8]),
        ),
    }


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    for number, (name, (vertices, faces)) in enumerate(odd_meshes().items()):
        for suffix, write in WRITERS.items():
            with np.errstate(all="ignore"):
                try:
                    data = write(vertices, faces)
                except (IndexError, struct.error):
                    continue  # no such thing in this format
            yield from _three(f"{name}-{suffix}", suffix, data, number % 4 == 0)
    for name, (suffix, data) in odd_files().items():
        yield from _three(name, suffix, data, suffix == "ply")
    for suffix, write in {**WRITERS, "binary.ply": binary_ply}.items():
        whole = write()
        for number in range(45):
            name = f"{suffix}-damaged-{number}"
            data = mutate(whole, rng_of(name, seed), 0, 300 if number % 2 else None)
            yield from _three(name, suffix, data, number % 15 == 0)


def odd_files() -> dict[str, tuple[str, bytes]]:
    """Return files that hold no mesh, by name, each with its suffix."""
    whole = ply()
    counts = {
        "huge-count": whole.replace(b"vertex 8", b"vertex 99999999999"),
        "huge-faces": whole.replace(b"face 12", b"face 2147483647"),
        "negative-count": whole.replace(b"vertex 8", b"vertex -8"),
        "no-count": whole.replace(b"vertex 8", b"vertex"),
        "text-count": whole.replace(b"vertex 8", b"vertex eight"),
        "other-type": whole.replace(b"double x", b"quad x"),
        "no-end": whole.replace(b"end_header", b"comment"),
        "no-format": whole.replace(b"format ascii 1.0\n", b""),
        "list-of-list": whole.replace(b"property double x", b"property list uchar int x"),
        "no-x": whole.replace(b"property double x\n", b""),
        "binary-said": whole.replace(b"ascii", b"binary_little_endian"),
        "big-endian-said": binary_ply().replace(b"little", b"big"),
        "long-comment": whole.replace(
            b"ascii 1.0\n", b"ascii 1.0\ncomment " + b"x" * 99999 + b"\n"
        ),
    }
    files = {name: ("ply", data) for name, data in counts.items()}
    for suffix in ("ply", "stl", "obj", "off", "glb", "3mf", "gltf", "dae", "xyz", "zip", "none"):
        files[f"empty-{suffix}"] = (suffix, b"")
        files[f"text-{suffix}"] = (suffix, b"hello\n" * 20)
        files[f"zeros-{suffix}"] = (suffix, bytes(500))
        files[f"binary-{suffix}"] = (suffix, bytes(range(256)) * 4)
    count = struct.pack("<I", 2**32 - 1)
    files["stl-count"] = ("stl", stl()[:80] + count + stl()[84:])
    files["stl-text"] = ("stl", b"solid x\nfacet normal 0 0 0\nouter loop\nvertex 1 2\nendloop\n")
    files["obj-zero"] = ("obj", obj().replace(b"f 1 ", b"f 0 "))
    files["obj-far"] = ("obj", obj().replace(b"f 1 ", b"f 999999 "))
    files["off-short"] = ("off", off().replace(b"8 12 0", b"8 9999999999 0"))
    files["glb-short"] = ("glb", b"glTF" + struct.pack("<III", 2, 20, 2**31) + b"JSON{}")
    files["gltf-deep"] = ("gltf", b"[" * 99999)
    files["gltf-file"] = (
        "gltf",
        b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "/dev/zero"}]}',
    )
    return files


def _three(name: str, suffix: str, data: bytes, also_slow: bool) -> Iterator[Case]:
    source = f"in.{suffix}"
    files = {source: data}
    yield sample(f"meshes/{name}", files, "-n", "8", source=source)
    if also_slow:
        yield sample(f"meshes/{name}-open", files, "-n", "8", "--allow-open", source=source)
