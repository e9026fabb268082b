"""Imports point one way, and the runtime is light."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "src" / "super_sdf").glob("*.py"))
EVALUATION = sorted((ROOT / "src" / "super_sdf" / "evaluation").glob("*.py"))
FLOORS = [
    {"errors", "containers", "compiling", "interrupts", "streams", "pace"},
    {"memory", "onnx", "progress", "extras", "machine", "index_width", "chunks"},
    {"planes", "cuda"},
    {"samples", "gradients"},
    {"sides", "spacing"},
    {"grid"},
    {"band", "mesh", "cell_cases", "running", "contract", "decoder"},
    {"nodes", "symmetry", "options", "offsets", "device"},
    {"files"},
    {"field", "network", "lattice"},
    {"isosurface", "border", "spheres"},
    {"survey", "kernels"},
    {"compiled", "footprint"},
    {"plan", "precision", "expectation"},
    {"pipeline"},
    {"convert"},
    {"cli_common", "cli_conversion", "__init__"},
    {"selftest", "cli_batch_report"},
    {"cli_batch", "cli_sample", "cli_evaluate", "cli_render", "cli_info"},
    {"cli"},
    {"entry"},
    {"__main__"},
]
BATCH = sorted((ROOT / "src" / "super_sdf" / "batch").glob("*.py"))
FILES = sorted((ROOT / "src" / "super_sdf" / "files").glob("*.py"))
FILES_FLOORS = [
    {"archives", "headers", "parts", "regular", "spool", "__init__"},
    {"output", "ply", "stl", "text_meshes", "glb", "unpacking"},
    {"threemf"},
    {"grids", "meshes"},
]
MACHINE = sorted((ROOT / "src" / "super_sdf" / "machine").glob("*.py"))
MACHINE_FLOORS = [
    {"records", "serving", "__init__"},
    {"pool"},
]
BATCH_FLOORS = [
    {"fingerprint", "journal", "walking", "__init__"},
    {"job", "lock"},
    {"manifest", "workers", "ledger"},
    {"inputs", "plan"},
    {"run"},
]
EVALUATION_FLOORS = [
    {"mesh_files", "published", "page", "folder", "__init__"},
    {"solid"},
    {"sampling", "metrics", "rendering", "sections"},
    {"cases"},
    {"methods"},
    {"peers"},
    {"measuring"},
    {"plan", "store", "tables", "timing"},
    {"runner"},
    {"results", "plots"},
    {"experiment_tables"},
    {"report"},
    {"evaluate"},
]


def imported(path: Path) -> set[str]:
    """Return the modules that a file imports anywhere, relative ones with their dots before."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")[0]
            names.add("." * node.level + module)
            if not module:  # from . import metrics
                names |= {"." * node.level + alias.name for alias in node.names}
    return names


def check_floors(sources: list[Path], floors: list[set[str]]) -> None:
    """Every module stands on one floor and imports from floors below, within its package."""
    floor = {name: level for level, names in enumerate(floors) for name in names}
    assert set(floor) - {"files", "machine"} == {path.stem for path in sources}
    for path in sources:
        for name in imported(path) & {f".{other}" for other in floor}:
            assert floor[name[1:]] < floor[path.stem], f"{path.stem} imports {name}"


def test_every_module_imports_only_from_floors_below():
    check_floors(SOURCES, FLOORS)
    check_floors(FILES, FILES_FLOORS)
    check_floors(MACHINE, MACHINE_FLOORS)
    check_floors(BATCH, BATCH_FLOORS)
    check_floors(EVALUATION, EVALUATION_FLOORS)


def test_the_runtime_needs_four_packages():
    allowed = {"click", "numpy", "onnxruntime", "trimesh"} | set(sys.stdlib_module_names)
    for path in SOURCES + FILES + MACHINE + BATCH:
        foreign = {name for name in imported(path) if not name.startswith(".")} - allowed
        if path.stem == "kernels":  # loaded only where numba is
            foreign -= {"numba"}
        assert not foreign, f"{path.stem} imports {foreign}"


def test_onnxruntime_is_imported_in_one_place():
    """There its telemetry is switched off before."""
    rooms = [ROOT / room for room in ("src", "tests", "export", "benchmarks", "examples")]
    importing = {
        path.name
        for room in rooms
        for path in room.rglob("*.py")
        if "onnxruntime" in imported(path)
    }
    assert importing == {"onnx.py"}


def test_the_runtime_does_not_know_the_evaluation():
    for path in SOURCES + FILES + MACHINE + BATCH:
        assert path.stem.startswith("cli_") or ".evaluation" not in imported(path)


def test_the_evaluation_does_not_know_the_command_line():
    for path in EVALUATION:
        assert not any(name.startswith(("..cli", "torch")) for name in imported(path))


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
