"""``--report`` and ``view``: what is checked before, what is written, what the browser opens."""

import os
import re
import stat
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
from batches import CONSTANT
from pages import blocks, wedge

from super_sdf import SdfGrid, reconstruct, write_mesh

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
    assert entry["meshes"] == "page"
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


def test_without_the_extra_a_page_says_that_nothing_is_checked(command, opened, monkeypatch):
    found = {"igl": None, "pyfqmr": None}
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda name: found.get(name, 1))
    assert command(*UPSAMPLE, "--report", "a.html")[0] == 0
    assert command("view", "a.npy", *UPSAMPLE[3:], "--out", "v.html")[0] == 0 and len(opened) == 1
    for page in ("a.html", "v.html"):
        (entry,) = files_of(page)
        ((label, why),) = entry["certificate"]
        assert label == "not checked" and why.startswith(
            "a check of the mesh, with residuals, needs"
        )
        assert [mesh["residuals"] for mesh in blocks(Path(page))["meshes-0"]] == [False, False]


def test_the_page_of_a_batch_made_without_one_names_failures_first(run_batch, grid_folder):
    run_batch("in")
    before = Path("out/a.ply").stat().st_mtime_ns
    assert run_batch(*BATCH)[0] == 1
    assert Path("out/a.ply").stat().st_mtime_ns == before
    bad, *made = files_of("page.html")
    assert [entry["name"] for entry in made] == ["a.ply", "deep/b.ply", "deep/er/c.d.ply"]
    assert all(entry["status"] == "ok" and entry["residual"] > 0 for entry in made)
    assert (bad["name"], bad["status"], bad["reason"]) == ("bad.ply", "failed", CONSTANT)
    assert blocks(Path("page.html"))["facts"]["alert"] == ""


def test_the_meshes_of_a_batch_are_beside_the_page(run_batch, grid_folder):
    assert "Check: mean residual" in run_batch(*BATCH)[2]
    made = [entry["meshes"] for entry in files_of("page.html")[1:]]
    assert sorted(made) == sorted(f"page-files/{name}" for name in os.listdir("page-files"))
    assert set(blocks(Path("page.html"))) == {"facts"}
    times = {path: path.stat().st_mtime_ns for path in Path("page-files").iterdir()}
    run_batch(*BATCH)  # a page that was written before is replaced, and nothing drawn again
    assert {path: path.stat().st_mtime_ns for path in Path("page-files").iterdir()} == times
    assert len(files_of("page.html")) == 4


def test_a_page_of_others_is_not_replaced_by_a_batch(run_batch, grid_folder):
    Path("page.html").write_text("mine")
    assert run_batch(*BATCH)[::2] == (1, "Error: page.html exists: remove it or use --force\n")
    assert Path("page.html").read_text() == "mine" and not Path("out").exists()
    Path("other-files").write_text("")
    want = "Error: other-files, for the meshes of the page, is no folder: move it\n"
    assert run_batch("in", "--report", "other.html")[::2] == (1, want)


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
