"""The house: rooms one above the other, each within its budget, and a light start."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "super_sdf"
# From the top: a room may import from those below it. Rooms of a line do not import each other.
ROOMS = [
    "cli",
    "batch",
    "pages",
    "convert",
    "functions.pyvista",
    "functions.scikit_image",
    "labels",
    "simplify check evaluation",
    "pipeline",
    "tiles",
    "functions",
    "truth",
    "files",
    "surface",
    "refine",
    "network",
    "grid",
    "options threads",
    "errors arrays",
    "__init__ __main__",
]
TOP = "pipeline convert options errors threads arrays __init__ __main__"
BUDGETS = {  # of lines, for some rooms together, as in the design, or, with a reason, larger
    TOP: 1308,  # 1,250; arrays, notes and warnings in Python, public names, the unit of a file
    "grid": 2273,  # 1,800; and kinds of which each was measured to be right or wrong without them
    "network": 501,  # 500; and the inputs of masks
    "refine": 1324,  # 1,300; and samples of 0 that are alone, what blurred masks tell
    "surface": 2226,  # 2,200; and what is noted of a mesh
    "tiles": 300,
    "files": 2697,  # 2,700; and readers and writers of other packages
    "functions": 680,  # 600; and scikit-image's ``marching_cubes``, modules, what is not reached
    "labels": 900,
    "simplify check truth evaluation": 1445,  # 1,100; the evaluation, for lab; what to simplify to
    "batch": 893,  # of 900
    "pages": 384,
    "cli": 899,  # 800; and standard streams, a row for each label, signals within a callback
}
MOST_MODULES, MOST_LOADED, MOST_IMPORTS = 90, 45, 114  # 90, 45, 110 in the design
MOST_LINES, MOST_OF_ALL = 15_806, 36_000
LIBRARIES = {"click", "numpy", "onnxruntime", "trimesh", "typing_extensions", "filelock", "psutil"}
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
}


def room_of(module: str) -> str:
    """Return the room of a module: itself, if it is a line of its own, or its folder."""
    return module if module in ROOMS else module.split(".")[0]


def level_of(room: str) -> int:
    """Return on which line a room is, counted from the top."""
    return next(number for number, line in enumerate(ROOMS) if room in line.split())


def name_of(path: Path) -> str:
    """Return the name by which a file of this repository is imported."""
    root = PACKAGE.parent if path.is_relative_to(PACKAGE) else ROOT
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


NAMES = {name_of(path): module for module, path in MODULES.items()}
BESIDE = {
    name_of(path): path for folder in ("lab", "export") for path in (ROOT / folder).rglob("*.py")
}


@cache
def imported(path: Path, when_run: bool = True) -> frozenset[str]:
    """Return the modules that a file imports anywhere when it runs, or also for type checkers."""
    found: set[str] = set()
    package = name_of(path.parent / "__init__.py").split(".")
    for node in imports(ast.parse(path.read_text()), when_run):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            continue
        base = package[: len(package) - node.level + 1] if node.level else []
        whole = ".".join([*base, *([node.module] if node.module else [])])
        below = {f"{whole}.{alias.name}" for alias in node.names}
        found |= (below & (NAMES.keys() | BESIDE.keys())) or {whole}
    return frozenset(found)


def imports(tree: ast.AST, when_run: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the statements that import."""
    if when_run and isinstance(tree, ast.If) and "TYPE_CHECKING" in ast.unparse(tree.test):
        return
    if isinstance(tree, (ast.Import, ast.ImportFrom)):
        yield tree
    for child in ast.iter_child_nodes(tree):
        yield from imports(child, when_run)


def own(module: str, when_run: bool = True) -> set[str]:
    """Return the modules of the package that one of them imports."""
    found = {NAMES[name] for name in imported(MODULES[module], when_run) if name in NAMES}
    return found - {module, "__init__"}


def lines_of(paths: Iterator[Path]) -> int:
    """Return how many lines some files have."""
    return sum(len(path.read_text().splitlines()) for path in paths)


def test_every_module_has_a_room():
    rooms = {room for line in ROOMS for room in line.split()}
    assert {room_of(module) for module in MODULES} <= rooms


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {"__init__", "__main__"}))
def test_a_module_imports_from_its_own_room_or_one_below(module):
    room = room_of(module)
    others = {name for name in own(module, when_run=False) if room_of(name) != room}
    above = [name for name in others if level_of(room_of(name)) <= level_of(room)]
    assert not above, f"{module} imports {above}"


def test_there_is_no_circle():
    TopologicalSorter({module: own(module) for module in MODULES}).prepare()
    known = {name: set(imported(path)) & BESIDE.keys() - {name} for name, path in BESIDE.items()}
    TopologicalSorter(known).prepare()


def test_the_package_imports_neither_the_laboratory_nor_training():
    tops = {name.split(".")[0] for path in MODULES.values() for name in imported(path)}
    assert not tops & {"lab", "export"}
    of_lab = set().union(*(imported(path) for name, path in BESIDE.items() if name[:3] == "lab"))
    assert not [name for name in of_lab if name.startswith("export")]


def test_rooms_import_from_few_others():
    """A module of the top is a room here; ``__main__``, as ``__init__``, only leads into one."""
    rooms = {
        (module.split(".")[0], name.split(".")[0])
        for module in MODULES.keys() - {"__main__"}
        for name in own(module)
    }
    assert len({(one, other) for one, other in rooms if one != other}) <= MOST_IMPORTS


@pytest.mark.parametrize("rooms", BUDGETS)
def test_a_room_is_within_its_budget(rooms):
    paths = (path for name, path in MODULES.items() if name.split(".")[0] in rooms.split())
    assert lines_of(paths) <= BUDGETS[rooms]


def test_the_house_is_small():
    assert len(MODULES) <= MOST_MODULES
    assert lines_of(iter(MODULES.values())) <= MOST_LINES
    folders = (ROOT / name for name in ("src", "lab", "export", "tests", "examples", "plugins"))
    assert lines_of(path for folder in folders for path in folder.rglob("*.py")) <= MOST_OF_ALL


@pytest.mark.parametrize("module", MODULES)
def test_what_every_conversion_needs_is_few_packages(module):
    tree = ast.parse(MODULES[module].read_text())
    at_once = {node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))}
    names = {a.name for node in at_once if isinstance(node, ast.Import) for a in node.names}
    names |= {str(n.module) for n in at_once if isinstance(n, ast.ImportFrom) and not n.level}
    others = {name.split(".")[0] for name in names} - LIBRARIES - set(sys.stdlib_module_names)
    is_extra = module.startswith(
        ("files.readers.", "simplify.", "check.", "truth", "evaluation", "pages.")
    )
    assert not others or is_extra or module in ("batch.cluster", "functions.pyvista")


def test_onnxruntime_is_imported_in_one_place():
    """There its telemetry is switched off before."""
    folders = [ROOT / name for name in ("src", "tests", "export", "lab", "examples", "plugins")]
    paths = [path for folder in folders for path in folder.rglob("*.py")]
    assert {path.name for path in paths if "onnxruntime" in imported(path)} == {"onnx.py"}


def loaded_by(tmp_path: Path, *words: str) -> set[str]:
    """Return the modules that a command has loaded at its end."""
    script = (
        "import sys; from super_sdf.cli.main import cli;"
        f"cli.main({list(words)!r}, standalone_mode=False); print(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, cwd=ROOT)
    return set(run.stdout.decode().splitlines()[-1].split())


def test_one_conversion_loads_little(tmp_path):
    words = "upsample", "examples/part.npz", f"{tmp_path}/part.ply", "--quality", "fast", "--quiet"
    loaded = loaded_by(tmp_path, *words)
    assert not loaded & {"ssl", "email", "xml.sax", "scipy", "trimesh", "dask", "torch"}
    assert len({name for name in loaded if name.startswith("super_sdf")}) <= MOST_LOADED


def test_a_command_chooses_the_threads_of_blas_before_numpy_starts_them(tmp_path):
    (tmp_path / "numpy.py").write_text("import os; exit(os.environ['OPENBLAS_NUM_THREADS'])")
    script = [sys.executable, "-c", "import super_sdf.cli.main"]
    run = subprocess.run(script, env={"PYTHONPATH": str(tmp_path)}, capture_output=True)
    assert run.stderr.split() == [b"1"]


def test_a_batch_without_a_cluster_loads_nothing_of_dask(tmp_path):
    words = "batch", "examples", "--out", str(tmp_path), "--quality", "fast", "--jobs", "1", "-q"
    assert not loaded_by(tmp_path, *words) & {"dask", "distributed", "tornado"}
