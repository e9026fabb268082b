"""What is no plain file: as input, as output, as a list, a network, or in a folder of inputs."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

from .case import Case, Content, ball, batch, npy, npz, sample, upsample


def _socket(path: Path) -> None:
    home = os.getcwd()
    os.chdir(path.parent)  # a socket's path may be 100 characters long and no more
    try:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(path.name)
    finally:
        os.chdir(home)


def _closed(path: Path) -> None:
    path.write_bytes(npy(ball()))
    path.chmod(0)


def _circle(path: Path) -> None:
    path.mkdir()
    (path / "in.npy").write_bytes(npy(ball()))
    (path / "me").symlink_to(".")
    (path / "up").symlink_to("..")


def _link(to: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(to)


DEVICES: dict[str, Content] = {
    name.rpartition("/")[2]: _link(name)
    for name in (
        *("/dev/zero", "/dev/null", "/dev/full", "/dev/urandom", "/dev/tty", "/dev/stdin"),
        *("/proc/self/mem", "/proc/self/status", "/proc/self/environ"),
    )
}
KINDS: dict[str, Content] = {
    **DEVICES,
    "fifo": os.mkfifo,
    "socket": _socket,
    "loop": lambda path: path.symlink_to(path.name),
    "dangling": _link("nowhere"),
    "link-to-folder": _link("."),
    "folder": lambda path: path.mkdir(),
    "closed": _closed,
    "closed-folder": lambda path: path.mkdir(0),
    "circle": _circle,
    "empty": b"",
    "long-line": lambda path: path.write_bytes(b"x" * 30_000_000),
}
GRID = {"good.npy": npy(ball()), "good.npz": npz(values=ball())}


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    del seed
    for kind, content in KINDS.items():
        for suffix in ("npy", "npz"):
            at = {f"in.{suffix}": content}
            name = f"special/{kind}-{suffix}"
            yield upsample(name, at)
            yield batch(f"{name}-batch", at)
            inside = {f"grids/in.{suffix}": content, "grids/good.npy": GRID["good.npy"]}
            yield batch(f"{name}-within", inside, source="grids")
            yield batch(f"{name}-pattern", inside, source=f"grids/*.{suffix}")
        for suffix in ("ply", "stl", "obj"):
            yield sample(f"special/{kind}-{suffix}-sample", {f"in.{suffix}": content}, "-n", "8")
        yield from _elsewhere(kind, content)
    yield from _roots()


def _elsewhere(kind: str, content: Content) -> Iterator[Case]:
    for suffix in ("txt", "jsonl"):
        at = {f"list.{suffix}": content}
        yield batch(f"special/{kind}-{suffix}", {**at, **GRID})
    listed = {"list.jsonl": b'{"in": "in.npy"}\n{"in": "good.npy"}\n', "in.npy": content, **GRID}
    yield batch(f"special/{kind}-listed", listed, source="list.jsonl")
    model = ("upsample", "good.npy", "out.ply", "--model", "net.onnx")
    yield Case(f"special/{kind}-model", model, {**GRID, "net.onnx": content}, ("out.ply",))
    if kind in DEVICES:
        return  # as a target: what follows links would write there
    for target in ("out.ply", "out.stl"):
        for option in ([], ["--force"]):
            at = {**GRID, target: content}
            name = f"special/{kind}-target-{target[4:]}{''.join(option)}"
            words = ("upsample", "good.npy", target, "--quality", "fast", *option)
            made = (target, "nowhere")  # the latter where it is a link to there
            yield Case(name, words, at, made)
    words = ("upsample", "good.npy", "to/out.ply", "--quality", "fast")
    made = ("to/out.ply", "out.ply")  # the latter where it is a link to the folder itself
    yield Case(f"special/{kind}-target-above", words, {**GRID, "to": content}, made)


def _roots() -> Iterator[Case]:
    circle = {"c": _circle}
    for source in ("c", "c/**/*.npy", "**/*.npy", "c/**", "c/*/*.npy", "**", "[", "c/[!a]n.npy"):
        yield batch(f"special/circle-{source.replace('/', '-')}", circle, source=source)
    for number, target in enumerate(
        ("/proc/out.ply", "/sys/out.ply", "/proc/self/out.ply", "/none/out.ply")
    ):
        yield upsample(f"special/system-{number}", GRID, source="good.npy", target=target)
    for number, source in enumerate(("/dev/zero", "/dev/stdin", "/proc/self/maps", "~", "-", ".")):
        yield upsample(f"special/source-{number}", {}, source=source)
        yield batch(f"special/source-{number}-batch", {}, source=source)
    yield upsample("special/root", {}, source="/")
