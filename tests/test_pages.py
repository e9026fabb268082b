"""Pages, ``--report`` and ``view``: what is packed, escaped, written, and what is opened."""

import base64
import json
import os
import re
import stat
import zlib
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
import trimesh
from batches import CONSTANT, LONE
from solids import wedge

from super_sdf import Mesh, SdfGrid, reconstruct, write_mesh
from super_sdf.pages import items
from super_sdf.pages.html import is_page, make_page, write_page
from super_sdf.pages.items import entry_of, packed_mesh

NASTY = '</script><img src=x onerror=alert(1)> & "quoted" \u2028\udcff'
EMPTY = {"title": "", "lead": "", "summary": [], "notes": [], "files": []}


def icosphere(subdivisions=3):
    found = trimesh.creation.icosphere(subdivisions, 5.0)
    return Mesh(np.array(found.vertices), np.array(found.faces, np.int32))


def unpack(packed):
    """Return vertices, faces and residual bytes of a packed mesh, as the page does."""
    n, m = packed["vertices"], packed["triangles"]
    raw = zlib.decompress(base64.b64decode(packed["data"]))
    places = np.cumsum(np.frombuffer(raw, "<u2", 3 * n), dtype=np.uint16).reshape(3, n).T
    faces = np.cumsum(np.frombuffer(raw, "<u4", 3 * m, 6 * n), dtype=np.uint32).reshape(m, 3)
    rest = raw[6 * n + 12 * m :]
    return np.array(packed["low"]) + packed["step"] * places, faces, np.frombuffer(rest, np.int8)


def test_a_packed_mesh_comes_out_within_half_a_step_and_a_large_one_simplified(monkeypatch):
    mesh = icosphere()
    moved = Mesh(mesh.vertices * [1, 2, 0.1] + [1e6, -3, 0], mesh.faces)
    packed = packed_mesh("ball", moved)
    vertices, faces, residuals = unpack(packed)
    assert packed["step"] == pytest.approx(20 / 65535)
    assert np.abs(vertices - moved.vertices).max() <= packed["step"] * 0.500001
    assert (faces == mesh.faces).all() and not len(residuals) and not packed["residuals"]
    assert packed["caption"] == "ball: 1,280 triangles"
    assert unpack(packed_mesh("no", Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))))[0].size == 0
    monkeypatch.setattr(items, "MOST_TRIANGLES", 300)
    packed = packed_mesh("ball", mesh)
    vertices, faces, _ = unpack(packed)
    assert 150 < len(faces) <= 300
    assert packed["caption"] == f"ball: 1,280 triangles, shown simplified to {len(faces)}"


def test_what_comes_from_files_cannot_be_markup_and_is_read_back(tmp_path):
    said = {**EMPTY, "title": NASTY, "files": [entry_of(NASTY, notes=[NASTY])]}
    page = make_page(said, {"0": [{"caption": NASTY}]})
    assert "<img src=x" not in page and "\u2028" not in page
    assert page.count("</script>") == page.count("<script") == 5
    found = blocks(page)
    assert found["facts"]["title"] == NASTY and found["facts"]["files"][0]["notes"] == [NASTY]
    assert found["meshes-0"] == [{"caption": NASTY}]
    write_page(page, tmp_path / "a.html")
    (tmp_path / "b.html").write_text("<!doctype html>")
    known = [is_page(tmp_path / name) for name in ("a.html", "b.html", "missing.html")]
    assert known == [True, False, False]


def blocks(page):
    """Return the JSON of a page's blocks by their id."""
    text = page if isinstance(page, str) else page.read_text("utf-8")
    pattern = r'<script type="application/json" id="([\w-]+)">(.*?)</script>'
    return {name: json.loads(said) for name, said in re.findall(pattern, text, re.DOTALL)}


UPSAMPLE = ("upsample", "a.npy", "a.ply", "--quality", "fast", "--factor", 2, "--spacing", 1)
BATCH = ("batch", "in", "--out", "out", *LONE)


def files_of(page):
    """Return the entries of a page."""
    return blocks(Path(page))["facts"]["files"]


def test_the_page_of_a_conversion_holds_all_of_it(command, folder):
    np.save("a.npy", wedge())
    code, _, err = command(*UPSAMPLE, "--report", "a.html")
    assert code == 0 and err.endswith("\nReport: a.html\n")
    assert sorted(os.listdir()) == ["a.html", "a.npy", "a.ply"]
    found = blocks(Path("a.html"))
    (entry,) = found["facts"]["files"]
    assert found["facts"]["title"] == "a.ply" and entry["status"] == "ok"
    assert entry["meshes"] == "page"
    assert entry["notes"] == ["origin not given: sample (0, 0, 0) is at 0, 0, 0"]
    triangles = found["meshes-0"][0]["triangles"]
    assert entry["line"] == f"{triangles:,} triangles, closed, from 24 x 24 x 24 samples"
    assert entry["seconds"] > 0 and entry["faults"] == [] and 0 < entry["residual"] < 0.1
    assert ["surface", "closed, oriented, manifold"] in entry["certificate"]
    ours, coarse = found["meshes-0"]
    assert ours["residuals"] and coarse["residuals"] and ours["triangles"] > coarse["triangles"]


def test_a_page_is_replaced_with_force_only(command, folder):
    np.save("a.npy", wedge())
    Path("a.html").write_text("mine")
    said = "Error: a.html exists: remove it or use --force\n"
    assert command(*UPSAMPLE, "--report", "a.html") == (1, "", said)
    assert Path("a.html").read_text() == "mine" and not Path("a.ply").exists()
    assert command(*UPSAMPLE, "--report", "a.html", "--force", "-q") == (0, "", "")
    assert files_of("a.html")
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


def test_the_page_of_a_batch_made_without_one_names_failures_first(command, grid_folder):
    command(*BATCH)
    assert command(*BATCH, "--report", "page.html")[0] == 1
    bad, *made = files_of("page.html")
    assert [entry["name"] for entry in made] == ["a.ply", "deep/b.ply", "deep/er/c.d.ply"]
    assert all(entry["status"] == "ok" and entry["residual"] > 0 for entry in made)
    assert (bad["name"], bad["status"], bad["reason"]) == ("bad.ply", "failed", CONSTANT)
    found = blocks(Path("page.html"))
    assert set(found) == {"facts"}
    beside = [entry["meshes"] for entry in made]
    assert sorted(beside) == sorted(f"page-files/{name}" for name in os.listdir("page-files"))
    times = [path.stat().st_mtime_ns for path in sorted(Path("page-files").iterdir())]
    command(*BATCH, "--report", "page.html")  # the page is replaced, and nothing drawn again
    assert [path.stat().st_mtime_ns for path in sorted(Path("page-files").iterdir())] == times
    assert len(files_of("page.html")) == 4


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


def test_errors_of_view_leave_nothing(command, opened):
    assert command("view", "no.ply") == (1, "", "Error: no.ply does not exist\n")
    Path("bad.ply").write_text("ply")
    code, _, err = command("view", "bad.ply")
    assert code == 1 and err.startswith("Error: bad.ply cannot be read as a mesh: ")
    assert not os.listdir("temporary")
