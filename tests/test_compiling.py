"""When compiled functions are used, and what happens where they cannot be."""

import os
import sys
import threading
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import ball, trilinear
from test_privacy import run_at_home

from super_sdf import reconstruct
from super_sdf.machine import compiling
from super_sdf.machine.compiling import (
    Compiled,
    compiled_twin,
    is_loaded,
    must_compile,
    try_compiled,
    use_compiled,
)
from super_sdf.slabs.cutting import whole
from super_sdf.slabs.footprint import CODE_BYTES, COMPILER_BYTES, slab_bytes
from super_sdf.steps.survey import survey

INSTEAD = "numba is installed but cannot be used, and NumPy takes longer"
MEND = "; mend it, or set SUPER_SDF_COMPILED=0"


@pytest.fixture(autouse=True)
def unloaded(monkeypatch):
    """A process in which nothing was loaded yet, numba installed and wanted."""
    monkeypatch.setattr(compiling, "_compiled", Compiled())
    monkeypatch.setattr(compiling, "find_spec", lambda name: "there")
    monkeypatch.setenv(compiling.SWITCH, "1")


def double(value):
    """Stand in for a NumPy function."""
    return [2 * value, "NumPy"]


def made_module(double=lambda value: [2 * value, "compiled"], wake=lambda: None):
    """Stand in for the compiled functions."""
    module = ModuleType(compiling.MODULE)
    module.double, module.wake, module.is_on_disk = double, wake, lambda: True
    return module


def test_two_threads_that_meet_at_the_import_both_get_whole_functions(monkeypatch):
    begun, may_end, imports, got = threading.Event(), threading.Event(), [], []

    def slow_import(name):
        imports.append(name)
        monkeypatch.setitem(sys.modules, name, ModuleType(name))  # half of it, as Python does
        begun.set()
        assert may_end.wait(60)
        sys.modules[name] = made_module()
        return sys.modules[name]

    monkeypatch.setattr(compiling, "import_module", slow_import)

    def ask():
        use_compiled(10**6)
        got.append(compiled_twin(double)(2))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    threads[0].start()
    assert begun.wait(60)
    for thread in threads[1:]:
        thread.start()
    threads[1].join(0.2)  # time for what must not happen
    may_end.set()
    for thread in threads:
        thread.join()
    assert got == [[4, "compiled"]] * 4 and imports == [compiling.MODULE]


def test_threads_with_the_real_numba_give_the_same_mesh(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(compiling, "_compiled", Compiled())
    monkeypatch.setenv(compiling.SWITCH, "0")
    want = reconstruct(ball(16, 4.0), trilinear).vertices
    monkeypatch.setenv(compiling.SWITCH, "1")
    meshes = []
    threads = [
        threading.Thread(target=lambda: meshes.append(reconstruct(ball(16, 4.0), trilinear)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert is_loaded() and try_compiled() == "" and len(meshes) == 4
    for mesh in meshes:
        np.testing.assert_array_equal(mesh.vertices, want)


def raising(error):
    """Return a function that fails."""

    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ImportError("Numba needs NumPy 2.3 or less\nand more"), "Numba needs NumPy 2.3 or less"),
        (RuntimeError("cannot cache function 'wake'"), "cannot cache function 'wake'"),
        (SystemError(), "SystemError"),
    ],
)
@pytest.mark.parametrize("stage", ["import", "wake"])
def test_a_numba_that_does_not_work_leaves_it_to_numpy(monkeypatch, error, reason, stage):
    module = made_module(wake=raising(error))
    imported = raising(error) if stage == "import" else lambda name: module
    monkeypatch.setattr(compiling, "import_module", imported)
    use_compiled(10**6)
    assert compiled_twin(double)(2) == [4, "NumPy"]
    assert try_compiled() == f"{INSTEAD} ({reason}){MEND}"
    assert compiling.why_not() == (f"{INSTEAD} ({reason}){MEND}",) and not is_loaded()
    monkeypatch.setattr(compiling, "import_module", lambda name: pytest.fail("tried again"))
    assert not use_compiled(10**6)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), EOFError("Ran out")])
def test_compiled_code_that_cannot_be_kept_leaves_it_to_numpy(monkeypatch, error):
    module = made_module(double=raising(error))
    monkeypatch.setattr(compiling, "import_module", lambda name: module)
    assert use_compiled(10**6) and compiling.why_not() == ()
    twin = compiled_twin(double)
    assert twin(2) == twin(2) == compiled_twin(double)(2) == [4, "NumPy"]
    assert compiling.why_not() == (f"{INSTEAD} ({error}){MEND}",)


def test_an_error_of_a_compiled_function_is_not_hidden(monkeypatch):
    module = made_module(double=raising(IndexError("a defect")))
    monkeypatch.setattr(compiling, "import_module", lambda name: module)
    use_compiled(10**6)
    with pytest.raises(IndexError, match="a defect"):
        compiled_twin(double)(2)


def test_without_numba_nothing_is_tried_and_nothing_said(monkeypatch):
    monkeypatch.setattr(compiling, "import_module", lambda name: pytest.fail("imported"))
    for missing in (lambda name: None, raising(ValueError("numba.__spec__ is None"))):
        monkeypatch.setattr(compiling, "find_spec", missing)
        assert not use_compiled(10**6) and compiled_twin(double) is double
        assert compiling.why_not() == () and try_compiled() == ""


UPSAMPLE = """
import sys
sys.path.insert(0, {folder!r})
from super_sdf.cli.main import main
sys.argv = ["super-sdf", "upsample", "in.npy", "out.ply", "--device", "cpu", "--spacing", "1"]
main()
"""
NOWHERE = """
from numba.core import caching
def refuse(self):
    raise OSError("read-only file system")
caching._CacheLocator.ensure_cache_path = refuse
"""


@pytest.mark.parametrize(
    ("before", "reason"),
    [
        ("open('numba.py', 'w').write('import no_llvm')", "No module named 'no_llvm'"),
        (NOWHERE, "cannot cache function 'wake': no locator available for file"),
    ],
)
def test_the_command_says_it_once_and_writes_the_same_mesh(tmp_path, monkeypatch, before, reason):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball(16, 4.0).values)
    runs = []
    for switch in "01":
        script = before * (switch == "1") + UPSAMPLE.format(folder=str(tmp_path))
        runs.append(run_at_home(tmp_path, script, SUPER_SDF_COMPILED=switch))
        assert runs[-1].returncode == 0, runs[-1].stderr
        os.rename("out.ply", f"{switch}.ply")
    (note,) = [line for line in runs[1].stderr.splitlines() if "numba" in line]
    assert note.startswith(f"Note: {INSTEAD} ({reason}") and "numba" not in runs[0].stderr
    assert Path("0.ply").read_bytes() == Path("1.ply").read_bytes()


def test_the_plan_counts_the_compiler_where_nothing_is_on_disk(monkeypatch):
    module = made_module()
    monkeypatch.setattr(compiling, "import_module", lambda name: module)
    band = survey(ball())
    slab = whole(band)
    bare = slab_bytes(band, slab.seen, slab.decoded, slab.planes, 4)
    assert try_compiled() == ""
    assert not must_compile()
    kept = slab_bytes(band, slab.seen, slab.decoded, slab.planes, 4)
    module.is_on_disk = lambda: False
    monkeypatch.setattr(compiling, "_compiled", Compiled())
    assert try_compiled() == "" and must_compile()
    anew = slab_bytes(band, slab.seen, slab.decoded, slab.planes, 4)
    assert (kept - bare, anew - kept) == (CODE_BYTES, COMPILER_BYTES)
