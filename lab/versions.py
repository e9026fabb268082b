"""Whether every release of Python and of the dependencies that is allowed works: a table.

    python -m lab versions
    python -m lab versions 3.10:newest 3.11:oldest 3.12:2026-07-01 3.12:1.23
    python -m lab versions 3.11:oldest --extras test --tests tests/test_images.py

A cell is an environment of its own, made by ``uv`` (``pip install uv``) from this tree's wheel. It
runs the main job, ``info --check`` and tests, and has the start of the SHA-256 of the mesh. A
column is what is installed: the ``oldest`` releases that ``pyproject.toml`` allows and that have a
wheel for this Python, the ``newest``, the newest of a day (``2026-07-01``), or a release of
onnxruntime (``1.23``) with the newest of all else. A dash says that there is no such release. Cells
that fail, and meshes that differ, are an error.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

from super_sdf.threads import count_cores

from . import parser_of
from .tables import markdown

ROOT = Path(__file__).parents[1]
PYTHONS = ["3.10", "3.11", "3.12", "3.13", "3.14"]
RELEASES = ["oldest", "2025-11-01", "2026-07-01", "newest"]
TESTS = ["tests/test_network.py", "tests/test_pipeline.py"]
FOR_TESTS = ["pytest>=8", "hypothesis>=6.100", "scipy>=1.15"]
UNAVAILABLE = ("No solution found", "No interpreter found", "Failed to download http")
SAYS = """
import platform
from importlib.metadata import version
names = ("onnxruntime", "numpy", "trimesh", "click", "filelock")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
"""


class UnavailableError(Exception):
    """There is no such interpreter or release."""


def try_cell(cell: tuple[str, str], wheel: Path, given: argparse.Namespace) -> tuple[str, str]:
    """Return what stands in a cell, the start of the mesh's SHA-256, and what failed."""
    python, releases = cell
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            own = folder / "venv" / "bin" / "python"
            uv("venv", "--python", find_python(python), str(folder / "venv"))
            # the dependencies by name, too: "oldest" is for what is asked for by name
            asked = ["-r", "pyproject.toml", *(f"--extra={extra}" for extra in given.extras)]
            asked += [str(wheel), *(FOR_TESTS if given.tests else ())]
            install = ["pip", "install", "--python", str(own), "--only-binary", ":all:"]
            uv(*install, *chosen(releases), *asked)
            print(run([own, "-c", SAYS], folder).strip(), file=sys.stderr, flush=True)
            mesh, command = folder / "part.ply", [own, "-m", "super_sdf"]
            run([*command, "upsample", ROOT / "examples" / "part.npz", mesh], folder)
            run([*command, "info", "--check"], folder)
            if given.tests:
                run([own, "-m", "pytest", "-p", "no:cacheprovider", *given.tests], ROOT)
            found, failure = hashlib.sha256(mesh.read_bytes()).hexdigest()[:8], ""
    except UnavailableError:
        found, failure = "-", ""
    except RuntimeError as error:
        found, failure = "fails", f"Python {python}, {releases}: {error}"
    print(f"{':'.join(cell)} {found}", file=sys.stderr, flush=True)
    return found, failure


def run(command: list[str | Path], folder: Path) -> str:
    """Run a command without the caller's Python path; return what it printed."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=folder, env=inherited, capture_output=True, text=True)
    if done.returncode:
        last = (done.stdout + done.stderr).strip().splitlines()[-12:]
        raise RuntimeError(f"{' '.join(map(str, command[1:4]))} fails:\n" + "\n".join(last))
    return done.stdout


def uv(*words: str) -> None:
    """Run ``uv``, which fetches no interpreter; UnavailableError if it finds no release."""
    beside = Path(sys.executable).with_name("uv")
    program = beside if beside.exists() else shutil.which("uv")
    if not program:
        raise SystemExit("the environments are made by uv: pip install uv")
    try:
        run([program, *words, "--quiet", "--no-python-downloads"], ROOT)
    except RuntimeError as error:
        if any(reason in str(error) for reason in UNAVAILABLE):
            raise UnavailableError(str(error)) from error
        raise


def chosen(releases: str) -> list[str]:
    """Return the words of ``uv pip install`` that choose releases."""
    if releases == "oldest":
        return ["--resolution", "lowest-direct"]
    if releases == "newest":
        return []
    return ["--exclude-newer", releases] if "-" in releases else [f"onnxruntime=={releases}.*"]


def find_python(version: str) -> str:
    """Return an interpreter: this one, one on the path, one of pyenv, or what uv may find."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    among = [sys.executable, shutil.which(f"python{version}") or ""]
    for path in [*among, *map(str, pyenv.glob(f"versions/{version}.*/bin/python"))]:
        ask = [path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        if path and subprocess.run(ask, capture_output=True, text=True).stdout.strip() == version:
            return path
    return version


def main() -> None:
    """Print the table; exit code 1 if anything failed or differs, or if nothing was tried."""
    parser = parser_of(__doc__)
    parser.add_argument("cells", nargs="*", metavar="PYTHON:RELEASES", help="instead of all")
    parser.add_argument("--extras", nargs="+", default=[], help="to install, such as formats")
    parser.add_argument("--tests", nargs="*", default=TESTS, help="test files to run")
    given = parser.parse_args()
    pairs = [tuple(cell.split(":")) for cell in given.cells] or list(product(PYTHONS, RELEASES))
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(count_cores()) as pool:
        uv("build", "--wheel", "--out-dir", name, str(ROOT))
        wheel = next(Path(name).glob("*.whl"))
        found = list(pool.map(lambda pair: try_cell(pair, wheel, given), pairs))
    cells = {pair: cell for pair, (cell, _) in zip(pairs, found)}
    columns = list(dict.fromkeys(releases for _, releases in pairs))
    pythons = dict.fromkeys(python for python, _ in pairs)
    rows = ([python, *(cells.get((python, each), "") for each in columns)] for python in pythons)
    print(markdown(["Python", *columns], rows))
    failures = [failure for _, failure in found if failure]
    passed = [cell for cell, _ in found if cell not in ("-", "fails")]
    print(f"{len(passed)} passed, {len(failures)} failed; different meshes: {len(set(passed))}")
    raise SystemExit("\n".join(failures) or int(len(set(passed)) != 1))
