"""Pages: meshes packed and unpacked, what is said of files, escaping, the security policy."""

import base64
import hashlib
import re
import zlib
from io import BytesIO

import numpy as np
import pytest
import trimesh
from conftest import ball
from pages import blocks, wedge
from PIL import Image
from skimage.measure import marching_cubes

from super_sdf import Mesh, SdfGrid, reconstruct
from super_sdf.check.check import FULL, check_mesh
from super_sdf.convert import Kept
from super_sdf.options import Options
from super_sdf.grid.cubic import cubic_grid
from super_sdf.pages import meshes
from super_sdf.pages.html import is_page, make_page, write_page
from super_sdf.pages.items import (Item, certificate_facts, entry_of, item_of, read_head, read_meshes, write_item)
from super_sdf.pages.meshes import coarse_surface, packed_mesh, residual_bytes, thumbnail
from super_sdf.refine.survey import survey

NASTY = '</script><img src=x onerror=alert(1)> & "quoted" \u2028\udcff'


def facts(**known):
    """Return the facts of a page with nothing in it but what is given."""
    empty = {"title": "", "lead": "", "alert": "", "summary": [], "notes": [], "files": []}
    return {**empty, **known}


def icosphere(subdivisions=3, radius=5.0):
    """A ball's mesh about the origin."""
    found = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.array(found.vertices), np.array(found.faces, np.int32))


def unpack(packed):
    """Return vertices, faces and residual bytes of a packed mesh, as the page does."""
    n, m = packed["vertices"], packed["triangles"]
    raw = zlib.decompress(base64.b64decode(packed["data"]))
    places = np.cumsum(np.frombuffer(raw, "<u2", 3 * n), dtype=np.uint16).reshape(3, n).T
    faces = np.cumsum(np.frombuffer(raw, "<u4", 3 * m, 6 * n), dtype=np.uint32).reshape(m, 3)
    rest = raw[6 * n + 12 * m :]
    return np.array(packed["low"]) + packed["step"] * places, faces, np.frombuffer(rest, np.int8)


def test_a_packed_mesh_comes_out_within_half_a_step():
    mesh = icosphere()
    moved = Mesh(mesh.vertices * [1, 2, 0.1] + [1e6, -3, 0], mesh.faces)
    packed = packed_mesh("ball", moved)
    vertices, faces, residuals = unpack(packed)
    assert packed["step"] == pytest.approx(20 / 65535)
    assert np.abs(vertices - moved.vertices).max() <= packed["step"] * 0.500001
    assert (faces == mesh.faces).all() and not len(residuals) and not packed["residuals"]
    assert packed["caption"] == "ball: 1,280 triangles"
    vertices, faces, _ = unpack(packed_mesh("no", Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))))
    assert vertices.shape == faces.shape == (0, 3)


def test_residuals_are_full_at_a_tenth_of_a_voxel_and_unknown_ones_are_told_apart():
    values = np.array([0, FULL, -FULL, 5, -5, FULL / 2, np.nan], np.float32)
    assert residual_bytes(values).tolist() == [0, 127, -127, 127, -127, 64, -128]
    assert certificate_facts({"error": "no room"}) == [["not checked", "no room"]]
    assert certificate_facts({}) == []


def test_a_large_mesh_is_simplified_and_its_caption_has_both_counts(monkeypatch):
    monkeypatch.setattr(meshes, "MOST_TRIANGLES", 300)
    packed = packed_mesh("ball", icosphere())
    vertices, faces, _ = unpack(packed)
    assert 150 < len(faces) <= 300
    assert packed["caption"] == f"ball: 1,280 triangles, shown simplified to {len(faces)}"
    assert Mesh(vertices, faces).volume() == pytest.approx(icosphere().volume(), rel=0.05)
    item = Item()
    item.show("ball", icosphere(), max_memory=10**6)
    assert not item.meshes and item.thumbnail and "not shown: simplifying" in item.remarks[0]


def coarse(grid, offset=0.0):
    """Return coarse marching cubes of a grid."""
    lattice = cubic_grid(grid, offset)
    return coarse_surface(survey(lattice, offset), lattice)


@pytest.mark.parametrize("direction", [None, ((-1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))])
def test_coarse_marching_cubes_lie_on_the_surface_and_face_outward(direction):
    values = ball(20, 6.0).values
    grid = SdfGrid.trusted(values * 2, (2, 2, 2), (5, -7, 1), direction=direction)
    mesh = coarse(grid)
    middle = grid.to_world(np.array(values.shape) / 2 - 0.37)
    radii = np.linalg.norm(mesh.vertices - middle, axis=1)
    assert np.abs(radii - 12).max() < 0.2 and mesh.is_closed()
    assert mesh.volume() == pytest.approx(4 / 3 * np.pi * 12**3, rel=0.05)
    grown = coarse(grid, offset=1.5)
    assert np.linalg.norm(grown.vertices - middle, axis=1).mean() == pytest.approx(13.5, abs=0.1)


def test_coarse_marching_cubes_are_those_of_a_library():
    """Of any field whose cells have one case: as many triangles, vertices at the same places."""
    mesh = coarse(SdfGrid(wedge(), 1.0))
    vertices, faces, _, _ = marching_cubes(wedge(), 0.0, method="lorensen")
    assert mesh.is_closed() and len(mesh.faces) == len(faces)
    assert np.abs(np.sort(mesh.vertices, 0) - np.sort(vertices, 0)).max() < 2e-3


def test_an_item_has_the_residuals_of_both_meshes_and_the_certificate():
    grid = SdfGrid(wedge(), (1.0, 1.0, 1.0))
    mesh = reconstruct(grid, factor=2)
    item = item_of(Kept(grid, mesh), Options())
    ours, coarse = item.meshes
    assert ours["caption"] == f"super-sdf: {len(mesh.faces):,} triangles"
    assert coarse["caption"].startswith("marching cubes of the samples: ")
    assert item.certificate == check_mesh(mesh, grid).report()
    means = [np.abs(unpack(each)[2].astype(float)).mean() for each in (ours, coarse)]
    assert 0 < means[0] < means[1]  # coarse marching cubes cut off the edges
    assert item.thumbnail and item.remarks == []
    thick = SdfGrid(wedge()[:, :, ::2], (1.0, 1.0, 2.0))
    caption = item_of(Kept(thick, mesh), Options()).meshes[1]["caption"]
    assert caption.startswith("marching cubes of the samples, made equally spaced: ")


def test_the_file_of_an_item_is_read_back_and_what_is_none_is_none(tmp_path):
    path, item = tmp_path / "0123456789abcdef.js", Item(remarks=["a\u2028b"], made_of="digest")
    item.show(NASTY, icosphere(1))
    write_item(item, path)
    head = read_head(path)
    assert (head.remarks, head.made_of, head.thumbnail) == (["a\u2028b"], "digest", item.thumbnail)
    assert head.meshes == [] and head.size == len(item.meshes[0]["data"])
    assert read_meshes(path) == item.meshes
    comment, call, rest = path.read_text("ascii").split("\n")
    assert comment.startswith("// {") and rest == ""
    assert call.startswith('superSdfMeshes("0123456789abcdef", [{"caption": "')
    for text in ("", "// ", "// []", '// {"other": 1}', "\0\xff"):
        path.write_text(text, "latin-1")
        assert read_head(path) is None
    assert read_head(tmp_path / "missing.js") is None


def test_a_thumbnail_is_a_small_picture_of_the_mesh_lit_from_the_right():
    kind, data = thumbnail(icosphere()).split(",")
    assert kind == "data:image/png;base64" and len(data) < 8000
    image = np.array(Image.open(BytesIO(base64.b64decode(data))).convert("L")).astype(int)
    assert image.shape == (160, 160) and image[0, 0] == 255
    inside = image[50:110, 50:110]
    assert (inside < 230).all() and len(np.unique(inside)) > 12
    assert inside[:20, 40:].mean() > inside[40:, :20].mean() + 20
    assert thumbnail(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))) is None


def test_what_comes_from_files_cannot_be_markup_and_is_read_back(tmp_path):
    said = facts(title=NASTY, files=[entry_of(NASTY, notes=[NASTY])])
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


@pytest.mark.parametrize("beside", [False, True])
def test_the_policy_allows_these_scripts_and_nothing_else(beside):
    page = make_page(facts(), beside=beside)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page).group(1)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))

    def hashes(kind):
        texts = re.findall(rf"<{kind}>(.*?)</{kind}>", page, re.DOTALL)
        digests = (hashlib.sha256(text.encode()).digest() for text in texts)
        return [f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests]

    assert len(hashes("script")) == 3
    assert rules["script-src"].split() == hashes("script") + ["'self'", "file:"] * beside
    assert rules["style-src"].split() == hashes("style")
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:"
    assert not re.search(r'(src|href)="(?!data:,)', page)
