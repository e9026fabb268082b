"""Lists of inputs for ``batch``: JSON oddities, odd paths, odd bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from .case import Case, ball, batch, mutate, npy, rng_of, words

GRID = {"a.npy": npy(ball()), "b.npy": npy(ball((11, 12, 13)))}
# What a value may be that is none of the right kind.
VALUES = [
    *("null", "true", "false", "0", "-1", "1.5", "1e400", "-1e400", "NaN", "Infinity", "-Infinity"),
    *('""', '"x"', "[]", "{}", "[1, 2]", "[1, 2, 3]", "[1, 1, 1, 1]", '["1", 1, 1]', "[null]"),
    *("[[1]]", '{"a": 1}', "1" + "0" * 400, "-1" + "0" * 400, "[1e400, 0, 0]", "1e-400", "5e-324"),
    *('"\\u0000"', '"\\ud800"', '"\\n"', "[" * 600 + "]" * 600, "9" * 5000, '"nan"', "[NaN, 0, 0]"),
    *('"4"', '"auto"', '"positive"', "2", "3", "16", "-4", "4.0", "1e308", "1e-308", "true "),
]
NAMES = ["in", "out", "factor", "spacing", "origin", "inside", "offset", "cap", "model", ""]
PATHS = [
    *words(". .. / a.npy/ ./a.npy ../a.npy a.npy/x ~ ~/a.npy //a.npy a a.NPY é.npy *.npy"),
    *words(
        "**/*.npy CON.npy .npy - --help.npy list.jsonl /dev/null /proc/self/mem a.npy:x none.npz"
    ),
    *("", " ", "b\0.npy", "a.npy\0", "\ud800.npy", "\udcff.npy", "n" * 300 + ".npy"),
    *("d/" * 3000 + "a.npy", "a\nb.npy", "a\u2028b.npy", "\ufeffa.npy", "file:///a.npy"),
]
TARGETS = [
    *words(".ply ..ply a.ply A.PLY a.txt a . .. /a.ply ../a.ply x/a.ply x//a.ply ./a.ply"),
    *words("x/../../a.ply report.jsonl report.jsonl/x.ply .super-sdf-batch a.ply/b.ply ~/x.ply"),
    *words(
        "a.stl a.obj a.off a.glb a.3mf report.jsonl.ply .super-sdf-batch/x.ply é.ply *.ply -.ply"
    ),
    *("", "x/" * 2000 + "a.ply", "n" * 300 + ".ply", "n" * 251 + ".ply", "n" * 245 + ".stl"),
    *("a\0.ply", "\ud800.ply", "\udcff.ply", "a\nb.ply", "a .ply"),
]
TEXTS = [
    *("", "\n", "\r", " ", "{", "{}", "[]", "null", '"a.npy"', "{}{}", "NaN", "\x1a", "\x00" * 100),
    *("[" * 99999, "{" * 5000, '{"in":' * 3000, '{"in": "a.npy"', '{"in": "a.npy"},'),
    *("{'in': 'a.npy'}", "a.npy", '{"in": "a.npy"} {"in": "b.npy"}', '\ufeff{"in": "a.npy"}'),
    *('{"in": "a.npy", "in": "b.npy"}', '{"in": "a.npy"}\r{"in": "b.npy"}'),
    *('{"in": "a.npy"}\u2028{"in": "b.npy"}', '{"in"\x0c: "a.npy"}', '{"in": "a.npy"}\n' * 500),
    '{"in": "a.npy", "out": "x.ply"}\n{"in": "b.npy", "out": "X.ply"}',
    '{"in": "a.npy", "out": "x.ply"}\n{"in": "b.npy", "out": "x.ply/y.ply"}',
    *('{"in": "\\u0000"}', '{"in": "a.npy", "spacing": ' + "9" * 5000 + "}", "# only a remark\n"),
    *('{"in": "\x00"}', '{"in": "a.npy", "__proto__": 1}', '{"IN": "a.npy"}', '{"in": "a.npy"}\n{'),
]
LISTS = [
    *("a.npy\r\nb.npy\r\n", "a.npy\rb.npy", "\ufeffa.npy", "#a.npy", " a.npy ", ".", "~"),
    *("a.npy\n\n\nb.npy", "a.npy\x00", "a.npy\x0cb.npy", "a.npy\u2028b.npy", '"a.npy"'),
    *("a.npy b.npy", "none.npy", "list.txt", "\t", "a.npy\n" * 3000, "x" * 100000),
]
OTHER = {
    "utf-16": '{"in": "a.npy"}'.encode("utf-16"),
    "latin": b'{"in": "\xe9.npy"}',
    "bad-utf8": b'{"in": "a.npy"}\n\xff\xfe',
    "overlong": b'{"in": "\xc0\x80.npy"}',
    "surrogate": b'{"in": "\xed\xa0\x80.npy"}',
    "binary": bytes(range(256)) * 20,
}


def jsonl(entries: list[dict[str, Any]]) -> bytes:
    """Return the lines of a manifest."""
    return "".join(json.dumps(entry) + "\n" for entry in entries).encode()


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    for name in NAMES:
        for number, value in enumerate(VALUES):
            text = f'{{"in": "a.npy", "{name}": {value}}}'
            text = text if name != "in" else f'{{"in": {value}}}'
            yield _case(f"value-{name}-{number}", text.encode())
    for number, path in enumerate(PATHS):
        yield _case(f"path-{number}", jsonl([{"in": path}]))
        yield _case(f"path-{number}-txt", path.encode("utf-8", "surrogatepass"), "txt")
        yield _case(f"path-{number}-dry", jsonl([{"in": path}]), "jsonl", "--dry-run")
    for number, path in enumerate(TARGETS):
        entries = [{"in": "a.npy", "out": path}, {"in": "b.npy"}]
        yield _case(f"target-{number}", jsonl(entries))
        yield _case(f"target-{number}-dry", jsonl(entries), "jsonl", "--dry-run", "--json")
    for number, text in enumerate(TEXTS):
        yield _case(f"text-{number}", text.encode())
    for number, text in enumerate(LISTS):
        yield _case(f"list-{number}", text.encode(), "txt")
    for name, data in OTHER.items():
        yield _case(name, data)
        yield _case(f"{name}-txt", data, "txt")
    yield from _damaged(seed)


def _case(name: str, data: bytes, suffix: str = "jsonl", *options: str) -> Case:
    files = {f"list.{suffix}": data, **GRID}
    return batch(f"manifests/{name}", files, *options)


def _damaged(seed: int) -> Iterator[Case]:
    entries = [
        {"in": "a.npy", "out": "x/y.ply", "spacing": 1.0, "origin": [0, 0, 0], "factor": 2},
        {"in": "b.npy", "inside": "negative", "offset": 0.5, "cap": True},
    ]
    whole = jsonl(entries)
    for number in range(150):
        name = f"damaged-{number}"
        yield _case(name, mutate(whole, rng_of(name, seed)))
