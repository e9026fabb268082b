"""``evaluate``: what stands in its folder from before, odd options, meshes that cannot be told."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator

from .case import Case, Content, evaluate
from .meshes import CUBE, ply

ROW = {"shape": "cube", "mesh": "0", "size": 8, "factor": 4, "method": "mc", "error": None}
RESULTS: dict[str, Content] = {
    "empty": b"",
    "list": b"[]\n",
    "number": b"1\n",
    "null": b"null\n",
    "deep": b"[" * 99999 + b"\n",
    "binary": bytes(range(256)),
    "bad-utf8": b"\xff\xfe\n",
    "nul": bytes(1000),
    "no-break": b'{"protocol": 1',
    "other": b'{"a": 1}\n',
    "row": json.dumps(ROW).encode() + b"\n",
    "long-number": b"9" * 5000 + b"\n",
    "folder": lambda path: path.mkdir(),
    "loop": lambda path: path.symlink_to(path.name),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "fifo": os.mkfifo,
}
PROTOCOLS = ["1", "2", "3", "4", "5", "6", "null", '"1"', "[]", "1e400"]
OPTIONS = [
    *(("--sizes", "0"), ("--sizes", "-1"), ("--sizes", "1"), ("--sizes", "2"), ("--sizes", "3")),
    *(("--sizes", "99999999"), ("--sizes", "1" + "0" * 400), ("--sizes", ""), ("--sizes",)),
    *(("--factor", "3"), ("--factor", "0"), ("--factor", "99999999999"), ("--limit", "0")),
    *(
        ("--jobs", "0"),
        ("--model", "none.onnx"),
        ("--model", ""),
        ("--methods", "x"),
        ("--up", "w"),
    ),
    *(("--peer-limit", "nan"), ("--peer-limit", "-1"), ("--experiments", "x"), ("--out", "")),
    *(("--experiment-shapes", "0"), ("--peers", "x"), ("--out", "cube.ply")),
]


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    del seed
    for name, content in RESULTS.items():
        yield _case(f"results-{name}", {"report/results.jsonl": content})
    for number, protocol in enumerate(PROTOCOLS):
        row = json.dumps({**ROW, "protocol": "<here>"}).replace('"<here>"', protocol)
        yield _case(f"protocol-{number}", {"report/results.jsonl": row.encode() + b"\n"})
    for number, options in enumerate(OPTIONS):
        yield _case(f"options-{number}", {}, *options)
    for name in ("report", "report/plots", "report/report.md"):
        yield _case(f"file-at-{name.replace('/', '-')}", {name: b"somebody's\n"})
    same = {"in/a/cube.ply": ply(), "in/b/cube.ply": ply(), "in/cube.obj": b"hello"}
    yield evaluate("reports/same-names", same, source="in")
    for number, name in enumerate((" .ply", "a\nb.ply", "é.ply", "[a](b).ply", "<b>.ply", "|.ply")):
        yield evaluate(f"reports/name-{number}", {name: ply()}, source=name)


def _case(name: str, files: dict[str, Content], *options: str) -> Case:
    """Return an evaluation of a cube."""
    return evaluate(f"reports/{name}", {**CUBE, **files}, *options, source="cube.ply")
