"""Meshes for ``sample``: damaged, empty, flat, open, odd in scale."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import numpy as np

from .case import Case, mutate, rng_of, sample, words

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def _head(form: str, number: str, vertices: np.ndarray, faces: np.ndarray) -> str:
    head = f"ply\nformat {form} 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property {number} {axis}\n" for axis in "xyz")
    return f"{head}element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"


def _rows(vertices: np.ndarray, faces: np.ndarray) -> str:
    rows = [" ".join(map(repr, map(float, v))) for v in vertices]
    rows += [f"{len(f)} " + " ".join(str(int(i)) for i in f) for f in faces]
    return "\n".join(rows)


def ply(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as text PLY."""
    head = _head("ascii", "double", vertices, faces)
    return (head + _rows(vertices, faces) + "\n").encode()


def binary_ply(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES) -> bytes:
    """Return a mesh as binary PLY."""
    head = _head("binary_little_endian", "float", vertices, faces).encode()
    rows = b"".join(struct.pack("<B3i", 3, *map(int, face)) for face in faces)
    return head + vertices.astype("<f4").tobytes() + rows


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
    return f"OFF\n{len(vertices)} {len(faces)} 0\n{_rows(vertices, faces)}".encode()


WRITERS: dict[str, Callable[..., bytes]] = {"ply": ply, "stl": stl, "obj": obj, "off": off}
CUBE = {"cube.ply": ply()}


def odd_meshes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return meshes that bound no solid, or an odd one."""
    changed = {}
    for text in words("nan inf 1e30 1e39 1e200 -1e308"):
        vertices = CORNERS.copy()
        vertices[3, 1] = float(text)
        changed[f"one-{text}"] = (vertices, FACES)
    for text in words("1e-320 1e-160 1e-46 1e-9 0 -1 1e9 1e38 1e154 1e155 1e300"):
        changed[f"times-{text}"] = (CORNERS * float(text), FACES)
        changed[f"at-{text}"] = (CORNERS + float(text), FACES)
    for index in (8, 2**31 - 1, -1, -(2**31)):
        faces = FACES.copy()
        faces[5, 1] = index
        changed[f"corner-{index}"] = (CORNERS, faces)
    others = {"two-cubes": CORNERS + 0.5, "far-apart": CORNERS + 1e9, "touching": CORNERS + 1}
    both = np.concatenate([FACES, FACES + 8])
    changed |= {name: (np.concatenate([CORNERS, at]), both) for name, at in others.items()}
    scales = {
        "flat": (1, 1, 0),
        "nearly-flat": (1, 1, 1e-12),
        "line": (1, 0, 0),
        "needle": (1e6, 1, 1),
    }
    changed |= {name: (CORNERS * scale, FACES) for name, scale in scales.items()}
    inner = np.concatenate([FACES, FACES[:, ::-1] + 8])
    return changed | {
        "no-faces": (CORNERS, FACES[:0]),
        "nothing": (CORNERS[:0], FACES[:0]),
        "no-vertices": (CORNERS[:0], FACES),
        "open": (CORNERS, FACES[:-1]),
        "inverted": (CORNERS, FACES[:, ::-1]),
        "one-turned": (CORNERS, np.concatenate([FACES[:1, ::-1], FACES[1:]])),
        "twice": (CORNERS, np.concatenate([FACES, FACES])),
        "both-ways": (CORNERS, np.concatenate([FACES, FACES[:, ::-1]])),
        "points": (CORNERS, np.zeros((12, 3), int)),
        "many-points": (np.concatenate([CORNERS, np.zeros((5000, 3))]), FACES),
        "inner": (np.concatenate([CORNERS, CORNERS / 3 + 0.3]), inner),
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


CHANGES = {
    b"vertex 8": (b"vertex 99999999999", b"vertex -8", b"vertex", b"vertex eight"),
    b"face 12": (b"face 2147483647",),
    b"property double x": (b"property quad x", b"property list uchar int x", b""),
    b"end_header": (b"comment",),
    b"format ascii 1.0\n": (b"", b"format ascii 1.0\ncomment " + b"x" * 99999 + b"\n"),
    b"ascii": (b"binary_little_endian",),
}


def odd_files() -> dict[str, tuple[str, bytes]]:
    """Return files that hold no mesh, by name, each with its suffix."""
    changed = [ply().replace(old, new) for old, many in CHANGES.items() for new in many]
    changed.append(binary_ply().replace(b"little", b"big"))
    files = {f"header-{number}": ("ply", data) for number, data in enumerate(changed)}
    for suffix in ("ply", "stl", "obj", "off", "glb", "3mf", "gltf", "dae", "xyz", "zip", "none"):
        files[f"empty-{suffix}"] = (suffix, b"")
        files[f"text-{suffix}"] = (suffix, b"hello\n" * 20)
        files[f"zeros-{suffix}"] = (suffix, bytes(500))
        files[f"binary-{suffix}"] = (suffix, bytes(range(256)) * 4)
    count, zero = struct.pack("<I", 2**32 - 1), b'{"asset": {"version": "2.0"}, "buffers": '
    text = b"solid x\nfacet normal 0 0 0\nouter loop\nvertex 1 2\nendloop\n"
    return files | {
        "stl-count": ("stl", stl()[:80] + count + stl()[84:]),
        "stl-text": ("stl", text),
        "obj-zero": ("obj", obj().replace(b"f 1 ", b"f 0 ")),
        "obj-far": ("obj", obj().replace(b"f 1 ", b"f 999999 ")),
        "off-short": ("off", off().replace(b"8 12 0", b"8 9999999999 0")),
        "glb-short": ("glb", b"glTF" + struct.pack("<III", 2, 20, 2**31) + b"JSON{}"),
        "gltf-deep": ("gltf", b"[" * 99999),
        "gltf-file": ("gltf", zero + b'[{"uri": "/dev/zero"}]}'),
    }


def _three(name: str, suffix: str, data: bytes, also_slow: bool) -> Iterator[Case]:
    source = f"in.{suffix}"
    files = {source: data}
    yield sample(f"meshes/{name}", files, "-n", "8", source=source)
    if also_slow:
        yield sample(f"meshes/{name}-open", files, "-n", "8", "--allow-open", source=source)
