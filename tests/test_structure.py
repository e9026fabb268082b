"""Imports point one way, and the runtime is light."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "src" / "super_sdf").glob("*.py"))
FLOORS = [
    {"errors"},
    {"grid", "memory"},
    {"band", "mesh", "conventions", "network", "cell_cases"},
    {"nodes", "io"},
    {"field"},
    {"isosurface"},
    {"pipeline"},
    {"cli", "__init__"},
]


def imported(path: Path) -> set[str]:
    """Return the modules that a file imports anywhere, relative ones with a dot before."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")[0]
            names.add(("." if node.level else "") + module)
    return names


def test_every_module_imports_only_from_floors_below():
    floor = {name: level for level, names in enumerate(FLOORS) for name in names}
    assert set(floor) == {path.stem for path in SOURCES}
    for path in SOURCES:
        for name in imported(path):
            if name.startswith(".") and name != ".":
                assert floor[name[1:]] < floor[path.stem], f"{path.stem} imports {name}"


def test_the_runtime_needs_four_packages():
    allowed = {"click", "numpy", "onnxruntime", "trimesh"} | set(sys.stdlib_module_names)
    for path in SOURCES:
        foreign = {name for name in imported(path) if not name.startswith(".")} - allowed
        assert not foreign, f"{path.stem} imports {foreign}"
        if path.stem != "network" and path.stem != "cli":
            assert "onnxruntime" not in imported(path)


def test_help_loads_click_and_nothing_heavier():
    script = (
        "import sys; from super_sdf.cli import cli; cli.main(['--help'], standalone_mode=False);"
        "heavy = {'numpy', 'onnxruntime', 'trimesh', 'torch'} & set(sys.modules); assert not heavy"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_public_names_are_there():
    import super_sdf

    for name in super_sdf.__all__:
        assert getattr(super_sdf, name) is not None
