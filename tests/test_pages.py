"""Pages: meshes packed and unpacked, what is said of files, escaping, the security policy."""

import base64
import hashlib
import re
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from pages import blocks, wedge
from skimage.measure import marching_cubes

from super_sdf import Mesh, SdfGrid, reconstruct
from super_sdf.check.check import FULL, check_mesh
from super_sdf.options import Options
from super_sdf.pages import items
from super_sdf.pages.html import is_page, make_page, write_page
from super_sdf.pages.items import coarse_surface, entry_of, item_of_files, packed_mesh

NASTY = '</script><img src=x onerror=alert(1)> & "quoted" \u2028\udcff'
EMPTY = {"title": "", "lead": "", "alert": "", "summary": [], "notes": [], "files": []}


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


def test_residuals_are_full_at_a_tenth_of_a_voxel_and_unknown_ones_are_told_apart():
    values = np.array([0, FULL, -FULL, 5, -5, FULL / 2, np.nan], np.float32)
    known = SimpleNamespace(has_evidence=True, residuals_at=lambda _: values)
    assert unpack(packed_mesh("", icosphere(0), known))[2].tolist() == [
        0,
        127,
        -127,
        127,
        -127,
        64,
        -128,
    ]


@pytest.mark.parametrize("direction", [None, ((-1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))])
def test_coarse_marching_cubes_are_those_of_a_library(direction):
    """Of any field whose cells have one case: as many triangles, vertices at the same places."""
    grid = SdfGrid.trusted(2 * wedge(), (2, 2, 2), (5, -7, 1), direction=direction)
    mesh = coarse_surface(grid)
    vertices, faces, _, _ = marching_cubes(wedge(), 0.0, method="lorensen")
    assert mesh.is_closed() and len(mesh.faces) == len(faces) and mesh.volume() > 0
    there = grid.to_world(vertices)
    assert np.abs(np.sort(mesh.vertices, 0) - np.sort(there, 0)).max() < 4e-3
    assert coarse_surface(grid, offset=1.0).volume() > 1.3 * mesh.volume()


def test_an_item_has_the_residuals_of_both_meshes_and_the_certificate(monkeypatch):
    grid = SdfGrid(wedge(), (1.0, 1.0, 1.0))
    mesh = reconstruct(grid, factor=2)

    made = SimpleNamespace(grid=grid, mesh=mesh)
    item = item_of_files("", "", Options(), made)
    ours, coarse = item.meshes
    assert ours["caption"] == f"super-sdf: {len(mesh.faces):,} triangles"
    assert coarse["caption"].startswith("marching cubes of the samples: ")
    assert item.certificate == check_mesh(mesh, grid).report() and item.remarks == []
    means = [np.abs(unpack(each)[2].astype(float)).mean() for each in (ours, coarse)]
    assert 0 < means[0] < means[1]  # coarse marching cubes cut off the edges
    monkeypatch.setattr("super_sdf.errors.find_spec", lambda name: None)
    bare = item_of_files("", "", Options(), made)
    assert len(bare.meshes) == 2 and not bare.meshes[0]["residuals"]
    assert bare.certificate["error"].startswith("a check of the mesh, with residuals, needs igl: ")


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


def test_the_policy_allows_these_scripts_and_nothing_else():
    page = make_page(EMPTY)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page).group(1)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))

    def hashes(kind):
        texts = re.findall(rf"<{kind}>(.*?)</{kind}>", page, re.DOTALL)
        digests = (hashlib.sha256(text.encode()).digest() for text in texts)
        return [f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests]

    assert len(hashes("script")) == 3
    assert rules["script-src"].split() == hashes("script")
    assert rules["style-src"].split() == hashes("style")
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:"
    assert not re.search(r'(src|href)="(?!data:,)', page)
