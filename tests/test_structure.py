"""Imports point down the list of rooms in docs/develop/tour.md, and the runtime is light."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "super_sdf"
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
}
BESIDE = {"lab", "export"}  # packages of a clone that are not in the wheel
# The library of each file format is imported by its reader or writer alone, when it is used.
READERS = {
    "fields.writing": {"vtkmodules"},
    "files.readers.nibabel": {"nibabel"},
    "files.readers.pydicom": {"pydicom"},
    "files.readers.simpleitk": {"SimpleITK"},
    "files.readers.h5py": {"h5py"},
    "files.readers.scipy": {"h5py", "scipy"},
    "files.readers.mrcfile": {"mrcfile"},
    "files.readers.nrrd": {"nrrd"},
    "files.readers.tifffile": {"tifffile"},
    "files.readers.vdb": {"numcodecs"},
    "files.readers.vtk": {"vtkmodules"},
    "files.readers.zarr": {"zarr"},
    "pyvista": {"pyvista"},
}
# Rooms that need more than the few packages that are always installed.
WITH_EXTRAS = {
    "certificate",
    "cluster",
    "pages",
    "simplification",
    "truth",
}


def room_of(module: str) -> str:
    """Return the folder of a module within the package, or the module itself."""
    return module.split(".")[0]


def rooms() -> list[set[str]]:
    """Return the rooms of the tour, those on a line together."""
    lines = (ROOT / "docs" / "develop" / "tour.md").read_text().splitlines()
    cells = [line.split("|")[1] for line in lines if line.startswith("| `")]
    return [set(re.findall(r"`(\w+)/?`", cell)) for cell in cells]


def name_of(path: Path) -> str:
    """Return the name by which a file of this repository is imported."""
    root = PACKAGE.parent if path.is_relative_to(PACKAGE) else ROOT
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


NAMES = {name_of(path): module for module, path in MODULES.items()}
FILES = {name_of(path): path for room in BESIDE for path in (ROOT / room).rglob("*.py")}


@cache
def imported(path: Path, when_run: bool = False) -> set[str]:
    """Return the modules that a file imports anywhere, or not only for type checkers."""
    found: set[str] = set()
    package = name_of(path.parent / "__init__.py").split(".")
    for node in imports(ast.parse(path.read_text()), when_run):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            continue
        base = package[: len(package) - node.level + 1] if node.level else []
        whole = ".".join([*base, *([node.module] if node.module else [])])
        below = {f"{whole}.{alias.name}" for alias in node.names}
        found |= (below & (NAMES.keys() | FILES.keys())) or {whole}
    return found


def imports(tree: ast.AST, when_run: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the statements that import."""
    if when_run and isinstance(tree, ast.If) and "TYPE_CHECKING" in ast.unparse(tree.test):
        return
    if isinstance(tree, (ast.Import, ast.ImportFrom)):
        yield tree
    for child in ast.iter_child_nodes(tree):
        yield from imports(child, when_run)


def own(path: Path) -> set[str]:
    """Return the modules of the package that one of its files imports."""
    return {NAMES[name] for name in imported(path) if name in NAMES}


def tops(path: Path) -> set[str]:
    """Return the packages, of others, that a file imports."""
    return {name.split(".")[0] for name in imported(path)} - {"super_sdf"}


def test_the_tour_names_every_room_once():
    named = [name for line in rooms() for name in line]
    assert sorted(named) == sorted({room_of(module) for module in MODULES})


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_from_its_own_room_or_one_below(module):
    level = {name: number for number, line in enumerate(rooms()) for name in line}
    for name in own(MODULES[module]) - {"__init__"}:  # that is the version
        room = room_of(name)
        assert room == room_of(module) or level[room] > level[room_of(module)], f"imports {name}"


def test_no_room_has_a_circle():
    TopologicalSorter({module: own(path) - {module} for module, path in MODULES.items()}).prepare()


def test_what_is_beside_the_package_has_no_circle_and_is_not_imported_by_it():
    """``export`` may import ``lab``, and both the package; never the other way round."""
    graph = {name: imported(path, when_run=True) for name, path in FILES.items()}
    known = {name: modules & graph.keys() - {name} for name, modules in graph.items()}
    TopologicalSorter(known).prepare()
    of_lab = set().union(*(known[name] for name in graph if name.startswith("lab.")))
    assert not [name for name in of_lab if name.startswith("export")]
    assert not [module for module, path in MODULES.items() if tops(path) & BESIDE]


@pytest.mark.parametrize("module", MODULES)
def test_no_string_names_a_module(module):
    strings = [node.value for node in ast.walk(ast.parse(MODULES[module].read_text()))
               if isinstance(node, ast.Constant) and isinstance(node.value, str)]  # fmt: skip
    assert not [text for text in strings if re.fullmatch(r"super_sdf(\.\w+)+", text)]
    assert "import_module" not in MODULES[module].read_text()


@pytest.mark.parametrize("module", [m for m in MODULES if room_of(m) not in WITH_EXTRAS])
def test_the_runtime_needs_few_packages(module):
    allowed = {"click", "numpy", "onnxruntime", "trimesh"} | set(sys.stdlib_module_names)
    allowed.add("typing_extensions")  # for type checkers alone, which have it
    others = {"batch.ledger": {"filelock"}, "machine.memory": {"psutil"}, **READERS}
    allowed |= others.get(module, set())
    assert tops(MODULES[module]) <= allowed


@pytest.mark.parametrize("room", sorted({room_of(m) for m in MODULES if "." in m}))
def test_every_room_says_what_lives_there(room):
    assert ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text()))


def test_onnxruntime_is_imported_in_one_place():
    """There its telemetry is switched off before."""
    rooms = [ROOT / room for room in ("src", "tests", "export", "lab", "examples")]
    importing = {
        path.name
        for room in rooms
        for path in room.rglob("*.py")
        if "onnxruntime" in imported(path)
    }
    assert importing == {"onnx.py"}


def test_help_loads_click_and_nothing_heavier():
    script = (
        "import sys; from super_sdf.cli.main import cli;"
        "cli.main(['--help'], standalone_mode=False);"
        "heavy = {'numpy', 'onnxruntime', 'trimesh', 'torch'} & set(sys.modules); assert not heavy"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_a_batch_without_a_cluster_loads_nothing_of_dask(tmp_path):
    script = (
        "import sys; from super_sdf.cli.main import cli;"
        f"cli.main(['batch', 'examples', '--out', {str(tmp_path)!r}, '--quality', 'fast',"
        "'--jobs', '2', '--quiet'], standalone_mode=False);"
        "heavy = {'dask', 'distributed', 'tornado'} & set(sys.modules); assert not heavy"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, cwd=ROOT)


def test_public_names_are_there():
    import super_sdf

    for name in super_sdf.__all__:
        assert getattr(super_sdf, name) is not None
