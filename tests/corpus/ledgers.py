"""What stands in a batch's output folder from before: its ledger, its lock, things of others."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .case import Case, Content, ball, batch, mutate, npy, rng_of
from .manifests import VALUES

GRID = {"in.npy": npy(ball())}
ROW: dict[str, Any] = {
    "in": "/somewhere/in.npy",
    "out": "in.ply",
    "status": "ok",
    "reason": None,
    "retry": False,
    "content": {"bytes": 7040, "blake2b": "00"},
    "output": {"bytes": 100, "blake2b": "00"},
    "seconds": 0.1,
    "closed": True,
    "inferred": [],
    "warnings": [],
    "options": "0123",
}
LINES = [
    *(b"", b"\n", b"{}", b"[]\n", b"null\n", b"1\n", b'"out"\n', b"{\n", b"[" * 99999 + b"\n"),
    *(b'{"out":' * 3000 + b"\n", b"\xff\xfe\n", b"\x00" * 100 + b"\n", b"no line break"),
    *(b"9" * 5000 + b"\n", b"NaN\n", b"\xef\xbb\xbf{}\n"),
]
BEGUN = [
    *(b"", b'"in.ply"\n', b"1\n", b"[]\n", b'"../x.ply"\n', b"{\n", b'"\\u0000"\n', b'"\\ud800"\n'),
    *(b'"/etc/x.ply"\n', b'"' + b"n" * 5000 + b'.ply"\n', b"\xff\n", b'"a/b/c.ply"\n' * 100),
    *(b"[" * 99999, b'""\n', b'"."\n', b'"in.ply/x"\n'),
]


def line(**changed: Any) -> bytes:
    """Return a row of the ledger with some values changed."""
    return json.dumps({**ROW, **changed}).encode() + b"\n"


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    for number, data in enumerate(LINES):
        yield _case(f"line-{number}", data)
        yield _case(f"line-{number}-after-ours", line() + data)
        yield _case(f"line-{number}-then-ours", data + line())
    for key in ROW:
        for number, value in enumerate(VALUES[:34]):
            text = json.dumps({**ROW, key: "<here>"}).replace('"<here>"', value)
            yield _case(f"row-{key}-{number}", text.encode() + b"\n")
    for key in ROW:
        yield _case(
            f"without-{key}", json.dumps({k: v for k, v in ROW.items() if k != key}).encode()
        )
    for number, data in enumerate(BEGUN):
        yield _case(f"begun-{number}", line(), **{"out/.super-sdf-batch": data})
        yield _case(
            f"begun-{number}-mesh", None, **{"out/.super-sdf-batch": data, "out/in.ply": b"x"}
        )
    yield from _damaged(seed)
    yield from _occupied()


def _case(
    name: str, ledger: bytes | None, *options: str, alone: bool = False, **more: Content
) -> Case:
    files = {**GRID, **more} if ledger is None else {**GRID, "out/report.jsonl": ledger, **more}
    return batch(f"ledgers/{name}", files, *options, alone=alone)


def _damaged(seed: int) -> Iterator[Case]:
    whole = line() + line(out="other.ply") + line(status="failed", reason="why", output=None)
    for number in range(120):
        name = f"damaged-{number}"
        data = mutate(whole, rng_of(name, seed))
        yield _case(name, data, *(["--retry"], ["--dry-run"], ["--force"], [])[number % 4])


def _occupied() -> Iterator[Case]:
    in_the_way: dict[str, Content] = {
        "folder": lambda path: path.mkdir(),
        "loop": lambda path: path.symlink_to(path.name),
        "dangling": lambda path: path.symlink_to("nowhere"),
        "fifo": os.mkfifo,
        "dev-full": lambda path: path.symlink_to("/dev/full"),
        "text": b"somebody's\n",
    }
    for what, content in in_the_way.items():
        for name in ("out", "out/in.ply", "out/report.jsonl", "out/.super-sdf-batch"):
            if what == "dev-full" and name == "out/in.ply":
                continue  # a program that follows the link would replace the device
            label = f"{what}-at-{Path(name).name}"
            for option in ([], ["--force"]):
                suffix = "".join(option)
                yield batch(
                    f"ledgers/{label}{suffix}", {**GRID, name: content}, *option, alone=True
                )
