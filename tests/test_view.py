"""``view``: the page is one file, and the browser is opened at it."""

import os
import re
import stat
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
from pages import blocks, wedge

from super_sdf import SdfGrid, reconstruct, write_mesh

QUICK = ("--spacing", "1", "--quality", "fast", "--factor", "2", "--device", "cpu")


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
    code, out, err = command("view", "a.npy", "b.ply", *QUICK)
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
    monkeypatch.setattr("super_sdf.machine.extras.find_spec", lambda name: found.get(name, 1))
    said = "view needs pyfqmr: pip install -e '.[report]' in a clone of super-sdf"
    assert command("view", "a.npy") == (1, "", f"Error: {said}\n") and not opened
