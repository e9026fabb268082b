"""``--report`` and ``view``: what is checked before, what is written, what the browser opens."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
from batches import CONSTANT
from pages import blocks, wedge

import super_sdf
from super_sdf import SdfGrid, reconstruct, write_mesh
from super_sdf.batch import page as batch_page
from super_sdf.batch.run import Run

UPSAMPLE = ("upsample", "a.npy", "a.ply", "--quality", "fast", "--factor", 2, "--spacing", 1)
BATCH = ("in", "--report", "page.html")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder of its own with a grid."""
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", wedge())


def files_of(page):
    """Return the entries of a page."""
    return blocks(Path(page))["facts"]["files"]


def test_the_page_of_a_conversion_holds_all_of_it(command, folder):
    code, _, err = command(*UPSAMPLE, "--report", "a.html")
    assert code == 0 and err.endswith("\nReport: a.html\n")
    assert sorted(os.listdir()) == ["a.html", "a.npy", "a.ply"]
    found = blocks(Path("a.html"))
    (entry,) = found["facts"]["files"]
    assert found["facts"]["title"] == "a.ply" and entry["status"] == "ok"
    assert entry["meshes"] == "page" and entry["thumbnail"].startswith("data:image/png;base64,")
    assert entry["notes"] == ["origin not given: sample (0, 0, 0) is at 0, 0, 0"]
    labels = [label for label, _ in found["facts"]["summary"]]
    assert labels == ["result", "time", "mean residual", "largest residual", "faults"]
    stages = dict(entry["stages"])
    assert {"read", "network", "isosurface"} <= set(stages) and stages["read"].endswith(" s")
    triangles = found["meshes-0"][0]["triangles"]
    assert entry["line"] == f"{triangles:,} triangles, closed, from 24 x 24 x 24 samples"
    assert entry["seconds"] > 0 and entry["faults"] == [] and 0 < entry["residual"] < 0.1
    assert ["surface", "closed, oriented, manifold"] in entry["certificate"]
    bounds = [float(number) for number in re.findall(r"[\d.]+", dict(entry["facts"])["bounds"])]
    assert bounds == pytest.approx([3.1, 6.8, 8.6, 19.5, 17.4, 14.8], abs=0.15)
    ours, coarse = found["meshes-0"]
    assert ours["residuals"] and coarse["residuals"] and ours["triangles"] > coarse["triangles"]


def broken(*arguments, **known):
    """Stand in for what fails."""
    raise RuntimeError("no display")


def test_check_and_page_take_grid_band_and_mesh_from_the_conversion(command, folder, monkeypatch):
    """Neither file is read again, and no band found again; the mesh is the same."""
    command(*UPSAMPLE)
    plain = Path("a.ply").read_bytes()
    for name in ("read_grid", "read_mesh", "survey"):
        monkeypatch.setattr(f"super_sdf.certificate.check.{name}", broken)
    reads = []
    planes = SdfGrid.planes
    monkeypatch.setattr(SdfGrid, "planes", lambda *given: reads.append(given) or planes(*given))
    assert command(*UPSAMPLE, "--force", "--check", "--report", "a.html")[0] == 0
    assert Path("a.ply").read_bytes() == plain and not reads
    assert len(blocks(Path("a.html"))["meshes-0"]) == 2


def test_a_page_needs_no_library_that_draws(folder):
    """Nor does a check; libigl itself imports SciPy."""
    script = (
        "import sys; from super_sdf.cli.main import cli;"
        f"cli.main({[str(word) for word in UPSAMPLE]} + ['--report', 'a.html', '--check', '-q'],"
        "standalone_mode=False);"
        "drawing = {'matplotlib', 'skimage', 'pyvista', 'vtkmodules'} & set(sys.modules);"
        "assert not drawing, drawing"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    package = Path(super_sdf.__file__).parent
    modules = [path for room in ("pages", "certificate") for path in package.glob(f"{room}/*.py")]
    assert len(modules) > 6 and not any("scipy" in path.read_text() for path in modules)


def test_a_page_is_replaced_with_force_only_and_replaces_no_input(command, folder):
    Path("a.html").write_text("mine")
    said = "Error: a.html exists: remove it or use --force\n"
    assert command(*UPSAMPLE, "--report", "a.html") == (1, "", said)
    assert Path("a.html").read_text() == "mine" and not Path("a.ply").exists()
    assert command(*UPSAMPLE, "--report", "a.html", "--force", "-q") == (0, "", "")
    assert files_of("a.html")
    before = Path("a.npy").read_bytes()
    os.link("a.npy", "b.html")
    said = "Error: b.html is the same file as a.npy: give another file\n"
    assert command(*UPSAMPLE, "--report", "b.html", "--force") == (1, "", said)
    assert Path("a.npy").read_bytes() == before
    code, _, err = command(*UPSAMPLE, "--report", "a.pdf", "--force")
    assert code == 2 and "a.pdf is not a page: give --report a file .html or .htm" in err


@pytest.mark.parametrize("arguments", [UPSAMPLE, ("batch", "a.npy", "--out", "out")])
def test_a_missing_extra_is_said_before_the_work(command, folder, monkeypatch, arguments):
    found = {"pyfqmr": None}
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda name: found.get(name, 1))
    said = "--report needs pyfqmr: pip install -e '.[report]' in a clone of super-sdf"
    assert command(*arguments, "--report", "a.html") == (1, "", f"Error: {said}\n")
    assert os.listdir() == ["a.npy"]


def test_a_mesh_without_room_for_the_check_has_a_page_that_says_so(command, folder, monkeypatch):
    monkeypatch.setattr("super_sdf.certificate.check.BYTES_PER_TRIANGLE", 10**9)
    assert command(*UPSAMPLE, "--report", "a.html", "--max-memory", "4G")[0] == 0
    (entry,) = files_of("a.html")
    assert entry["certificate"][0][0] == "not checked" and entry["meshes"] == "page"
    assert not any(mesh["residuals"] for mesh in blocks(Path("a.html"))["meshes-0"])


def test_the_page_of_a_batch_made_without_one_names_failures_first(run_batch, grid_folder):
    run_batch("in")
    before = Path("out/a.ply").stat().st_mtime_ns
    assert run_batch(*BATCH)[0] == 1
    assert Path("out/a.ply").stat().st_mtime_ns == before
    bad, *made = files_of("page.html")
    assert [entry["name"] for entry in made] == ["a.ply", "deep/b.ply", "deep/er/c.d.ply"]
    assert all(entry["status"] == "ok" and entry["residual"] > 0 for entry in made)
    assert all(entry["thumbnail"] and entry["meshes"] == "page" for entry in made)
    assert (bad["name"], bad["status"], bad["reason"]) == ("bad.ply", "failed", CONSTANT)
    found = blocks(Path("page.html"))
    assert found["facts"]["alert"] == "" and not Path("page-files").exists()
    assert set(found) == {"facts", *(f"meshes-{entry['id']}" for entry in made)}


def test_many_meshes_are_beside_the_page(run_batch, grid_folder, monkeypatch):
    monkeypatch.setattr(batch_page, "MOST_WITHIN", 0)
    assert "Check: mean residual" in run_batch(*BATCH)[2]
    made = [entry["meshes"] for entry in files_of("page.html")[1:]]
    assert sorted(made) == sorted(f"page-files/{name}" for name in os.listdir("page-files"))
    assert set(blocks(Path("page.html"))) == {"facts"}
    times = {path: path.stat().st_mtime_ns for path in Path("page-files").iterdir()}
    run_batch(*BATCH)  # a page that was written before is replaced, and nothing drawn again
    assert {path: path.stat().st_mtime_ns for path in Path("page-files").iterdir()} == times
    assert len(files_of("page.html")) == 4


def test_a_resumed_batch_shows_files_of_all_runs(run_batch, grid_folder):
    for names in ("in/a.npy", "in/deep"):
        run_batch(names, "--report", "page.html")
    entries = {entry["name"]: entry for entry in files_of("page.html")}
    assert set(entries) == {"a.ply", "b.ply", "er/c.d.ply"}
    said = "not drawn: run the command again for its picture and its meshes"
    assert entries["a.ply"]["remarks"] == [said]
    os.remove("out/a.ply")  # a mesh that is gone is not in the page
    run_batch("in/deep", "--report", "page.html")
    assert {entry["name"] for entry in files_of("page.html")} == {"b.ply", "er/c.d.ply"}


def test_an_interrupted_batch_writes_an_incomplete_page(run_batch, grid_folder, monkeypatch):
    keep, kept = Run._keep, []

    def interrupted(self, job, row):
        keep(self, job, row)
        kept.append(job.target)
        if len(kept) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Run, "_keep", interrupted)
    code, _, err = run_batch(*BATCH)
    assert code == 130 and err.startswith("Error: interrupted: ")
    said = "Incomplete, interrupted: 2 not finished; run it again to go on"
    assert blocks(Path("page.html"))["facts"]["alert"] == said
    waiting = [entry["name"] for entry in files_of("page.html") if entry["status"] == "waiting"]
    assert len(waiting) == 2 and not set(waiting) & set(kept)
    monkeypatch.setattr(Run, "_keep", keep)
    run_batch(*BATCH)
    assert blocks(Path("page.html"))["facts"]["alert"] == ""
    assert {entry["status"] for entry in files_of("page.html")} == {"ok", "failed"}


def test_a_page_of_others_is_not_replaced_by_a_batch(run_batch, grid_folder):
    Path("page.html").write_text("mine")
    assert run_batch(*BATCH)[::2] == (1, "Error: page.html exists: remove it or use --force\n")
    assert Path("page.html").read_text() == "mine" and not Path("out").exists()
    Path("other-files").write_text("")
    want = "Error: other-files, for the meshes of the page, is no folder: move it\n"
    assert run_batch("in", "--report", "other.html")[::2] == (1, want)


def test_a_bug_in_the_page_of_a_mesh_costs_no_mesh(run_batch, grid_folder, monkeypatch):
    monkeypatch.setattr("super_sdf.pages.items.item_of_files", broken)
    monkeypatch.setattr(batch_page.BatchPage, "item", lambda *arguments: None)
    code, _, _ = run_batch("in/a.npy", "--report", "page.html")
    assert code == 0 and Path("out/a.ply").exists()
    (entry,) = files_of("page.html")
    assert entry["certificate"] == [["not checked", "RuntimeError: no display"]]


@pytest.fixture
def opened(tmp_path, monkeypatch):
    """Work in a folder with a grid and a mesh; return the addresses that a browser is opened at."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr("tempfile.tempdir", None)
    Path("temporary").mkdir()
    np.save("a.npy", wedge())
    write_mesh(reconstruct(SdfGrid(wedge(), 1.0), factor=2), "b.ply")
    addresses = []
    monkeypatch.setattr("webbrowser.open", lambda address: addresses.append(address) or True)
    return addresses


def test_the_page_is_a_private_file_that_the_browser_opens(command, opened):
    code, out, err = command("view", "a.npy", "b.ply", *UPSAMPLE[3:], "--device", "cpu")
    assert (code, out, err) == (0, "", opened[0] + "\n") and len(opened) == 1
    page = Path(url2pathname(urlsplit(opened[0]).path))
    assert page.is_relative_to(Path("temporary").absolute())
    assert stat.S_IMODE(page.parent.stat().st_mode) == 0o700
    found = blocks(page)
    assert [file["meshes"] for file in found["facts"]["files"]] == ["page", "page"]
    assert [len(found[f"meshes-{number}"]) for number in (0, 1)] == [2, 1]
    assert "'self'" not in page.read_text("utf-8")  # it may load nothing from beside it
    assert sorted(os.listdir()) == ["a.npy", "b.ply", "temporary"]


def test_the_page_is_kept_where_it_is_asked_for(command, opened):
    assert command("view", "b.ply", "--out", "page.html", "--no-browser")[0] == 0
    assert not opened and blocks(Path("page.html"))["facts"]["title"] == "b.ply"
    want = (1, "", "Error: page.html exists: remove it or use --force\n")
    assert command("view", "b.ply", "--out", "page.html") == want
    want = (0, "", f"{Path('page.html').absolute().as_uri()}\n")
    assert command("view", "b.ply", "--out", "page.html", "--force") == want
    os.link("b.ply", "link.html")
    want = (1, "", "Error: link.html is the same file as b.ply: give another file\n")
    assert command("view", "b.ply", "--out", "link.html", "--force") == want
    code, _, err = command("view", "b.ply", "--out", "page.txt")
    assert code == 2 and "page.txt is not a page: give --out a file .html or .htm" in err
    assert not os.listdir("temporary")


def test_without_a_browser_that_is_said_and_errors_leave_nothing(command, opened, monkeypatch):
    assert command("view", "no.ply") == (1, "", "Error: no.ply does not exist\n")
    Path("bad.ply").write_text("ply")
    code, _, err = command("view", "bad.ply")
    assert code == 1 and err.startswith("Error: bad.ply cannot be read as a mesh: ")
    assert not os.listdir("temporary")
    monkeypatch.setattr("webbrowser.open", lambda address: False)
    code, _, err = command("view", "b.ply")
    note = "Note: no browser can be started here: open that address in yours"
    assert code == 0 and re.fullmatch(rf"file://\S+/view.html\n{note}\n", err)
    found = {"pyfqmr": None}
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda name: found.get(name, 1))
    said = "view needs pyfqmr: pip install -e '.[report]' in a clone of super-sdf"
    assert command("view", "a.npy") == (1, "", f"Error: {said}\n") and not opened
