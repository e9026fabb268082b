"""Odd options and arguments of every command."""

from __future__ import annotations

from collections.abc import Iterator

from .case import Case, ball, batch, npy, sample, upsample, words
from .meshes import CUBE

LINES = [
    *("upsample a b c", "batch", "batch in.npy", "batch --out out", "sample", "sample cube.ply"),
    *("sample cube.ply out.npz", "info x", "info", "info --json", "info --device cuda", "info -h"),
    *("sample -h", "sample cube.ply out.npz -n 8 --spacing 1"),
    "sample cube.ply out.npz --frame unit --spacing 1",
    "upsample in.npy out.ply --quality best --model none.onnx",
    "upsample in.npy out.ply --device cuda",
    "batch in.npy in.npy --out out --quality fast --jobs 1",
    "batch in.npy ./in.npy --out out --quality fast --json --dry-run",
]
GRID = {"in.npy": npy(ball())}
NUMBERS = [
    *words("x nan inf -inf 1e999 -1 0 -0 1e-400 5e-324 1e308 1_0 1,5 1,1,1 ,, 1,,1 1,1,1,1 0x10"),
    *words("1. +1 1e --1 1,nan,1 true 4 3 64 -4 2.0 2147483648 9223372036854775808 99999999999999"),
    *("", " ", "1" + "0" * 400, "-1" + "0" * 400, "1 1 1", "\uff11", "٣", "½", "1\n"),
]
WORDS = [
    "",
    " ",
    "x",
    "AUTO",
    "é",
    "a\nb",
    "\udcff",
    "-",
    "--",
    "n" * 5000,
    "0",
    "None",
    "\x1b[31m",
]
SIZES = [
    *words("0 -1 1 1K 1k 1M 100M 1T 1e9 1e400 nan inf G 1GB .5G -1G 1_000M 0x1 1e-9G"),
    *("", "1 G", "1" + "0" * 400, "1" + "0" * 400 + "G", "\uff15M", "²", "\n"),
]
TARGETS = [
    *words(". .. / out out. .ply out.PLY out.xyz out.npy none/out.ply out.ply/ in.npy"),
    *words("in.npy/out.ply ~/no/out.ply -out.ply é.ply *.ply folder.ply there.ply a:b.ply"),
    "folder.ply/x.ply",
    *("", " .ply", "a\nb.ply", "\udcff.ply", "d/" * 2100 + "out.ply", "n" * 300 + ".ply"),
    *("n" * 251 + ".ply", "n" * 250 + ".stl", "n" * 240 + ".obj"),
]
ALIKE = "--factor --spacing --origin --offset --threads --simplify --triangles"
NUMBER_OPTIONS = {"upsample": ALIKE, "batch": ALIKE, "sample": "-n --spacing --padding --band"}
WORD_OPTIONS = {
    "upsample": "--inside --mesher --quality --precision --model --device --none",
    "batch": "--format --inside --quality --model --none",
    "sample": "--frame --none",
    "info": "--device --none",
}


def cases(seed: int) -> Iterator[Case]:
    """Yield the cases of this theme."""
    del seed
    for texts, names in ((NUMBERS, NUMBER_OPTIONS), (WORDS, WORD_OPTIONS)):
        for command, options in names.items():
            for option in options.split():
                for number, text in enumerate(texts):
                    yield _case(f"{command}{option}-{number}", command, option, text)
    for number, text in enumerate(SIZES):
        yield _case(f"upsample-max-memory-{number}", "upsample", "--max-memory", text)
        yield _case(f"batch-max-memory-{number}", "batch", "--max-memory", text)
    yield from _targets()
    yield from _lines()


def _case(name: str, command: str, *options: str) -> Case:
    name = f"options/{name}"
    huge = any(len(text) > 6 and text.isdigit() for text in options)
    if command == "upsample":
        return upsample(name, GRID, *options, alone=huge)
    if command == "batch":
        return batch(name, GRID, *options, alone=huge)
    if command == "sample":
        count = () if options[0] in ("-n", "--spacing") else ("-n", "8")
        return sample(name, CUBE, *count, *options, source="cube.ply")
    return Case(name, (command, *options))


def _targets() -> Iterator[Case]:
    taken = {"folder.ply/x": b"", "there.ply": b"somebody's", **GRID, **CUBE}
    for number, target in enumerate(TARGETS):
        for option in ([], ["--force"]):
            name = f"options/target-{number}{''.join(option)}"
            yield upsample(name, taken, *option, source="in.npy", target=target)
        grid = target.replace(".ply", ".npz")
        name = f"options/sample-target-{number}"
        yield sample(name, taken, "-n", "8", source="cube.ply", target=grid)
        words = ("batch", "in.npy", "--out", target.removesuffix(".ply"), "--quality", "fast")
        if target not in ("/", "..", "", ".", "~/no/out.ply", "in.npy"):
            yield Case(f"options/batch-out-{number}", (*words, "--jobs", "1"), taken, ("*",))


def _lines() -> Iterator[Case]:
    lines = [
        *([""], ["x"], ["--x"], ["-h"], ["--version"], ["upsample"], ["upsample", "in.npy"]),
        *(["upsample", "\udcff.npy", "out.ply"], ["upsample", "a\nb.npy", "out.ply"], ["\udcff"]),
        *(["batch", "n" * 5000, "--out", "out"], ["upsample", "n" * 5000 + ".npy", "out.ply"]),
        *(["upsample", "n" * 300 + ".npy", "out.ply"], ["batch", "n" * 300 + ".npy", "--out", "o"]),
        ["sample", "n" * 300 + ".ply", "out.npz", "-n", "8"],
        *map(str.split, LINES),
    ]
    for number, line in enumerate(lines):
        made = ("out.*", "out", "out/*", "o", "o/*")
        yield Case(f"options/line-{number}", tuple(line), {**GRID, **CUBE}, made, alone=True)
