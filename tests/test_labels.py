"""Labels of an image in one run: closed meshes, walls that coincide, no worse than one by one."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
from conftest import trilinear

from super_sdf import load_network, make_grid, reconstruct, reconstruct_labels
from super_sdf.errors import GridError, OptionError, OutOfMemoryError


@pytest.fixture(scope="module")
def network():
    """The shipped network, in place of which that for masks is used."""
    return load_network("fast", threads=1)


def ball(centre, radius):
    """Return the distance to a ball as a function of points."""
    return lambda p: np.linalg.norm(p - np.array(centre), axis=-1) - radius


def painted(shape, spacing, solids):
    """Return the labels of solids, the first on top."""
    at, labels = np.indices(shape).transpose(1, 2, 3, 0) * spacing, np.zeros(shape, int)
    for nth, solid in enumerate(solids):
        labels[(solid(at) <= 0) & (labels == 0)] = nth + 1
    return labels


def nested():
    """Return a label inside another, with two voxels of a third and a single one of a fourth."""
    labels = np.zeros((12, 11, 13), int)
    labels[2:10, 2:9, 2:11] = 7
    labels[4:8, 4:7, 4:8] = -3
    labels[5, 5, 5:7] = 40
    labels[10, 9, 11] = 9
    return labels


NOISE = np.random.default_rng(0)
IMAGES = {
    "noise": NOISE.integers(0, 4, (6, 7, 5)),
    "no ground": NOISE.integers(1, 9, (5, 6, 7)),
    "one label": NOISE.integers(0, 2, (6, 5, 6)),
    # four labels meet at a line, eight at a point
    "octants": 1 + sum((np.indices((8, 8, 8))[axis] >= 4) << axis for axis in range(3)),
    "nested": nested(),
    "layers": np.arange(6)[:, None, None] // 2 * np.ones((6, 4, 5), int),
}


def corners_of(mesh):
    """Return the triangles of a mesh by the bytes of their corners, from the lowest corner on."""
    found = Counter()
    for triangle in mesh.vertices[mesh.faces]:
        corners = [corner.tobytes() for corner in triangle]
        first = corners.index(min(corners))
        found[tuple(corners[first:] + corners[:first])] += 1
    return found


@pytest.mark.parametrize("name, factor", [("noise", 4), *((name, 2) for name in IMAGES)])
def test_meshes_are_closed_and_share_their_walls(name, factor):
    labels, spacing = IMAGES[name], (1.0, 0.75, 2.5)
    meshes = reconstruct_labels(labels, network=trilinear, factor=factor, spacing=spacing)
    assert list(meshes) == sorted(set(np.unique(labels)) - {0})
    triangles = {label: corners_of(mesh) for label, mesh in meshes.items()}
    seen = sum(triangles.values(), Counter())
    for label, mesh in meshes.items():
        assert mesh.is_closed() and mesh.volume() > 0
        assert set(triangles[label].values()) == {1}
    for a, b, c in seen:  # no two labels are on the same side of a triangle, nor three beside it
        assert seen[a, b, c] == 1
    if name == "layers":  # a wall across the grid, of which each label has one side
        one, other = (set(map(bytes, mesh.vertices)) for mesh in meshes.values())
        assert len(one & other) > 50


def test_what_does_not_fit_in_memory_is_refused():
    with pytest.raises(OutOfMemoryError, match=r"^8 labels in 210 samples, .* \(--max-memory\)$"):
        reconstruct_labels(IMAGES["no ground"], network=trilinear, spacing=1, max_memory=10**6)


def test_a_label_beside_no_other_has_the_mesh_that_it_has_alone(network):
    labels = np.where(ball((7.3, 8.1, 7.7), 4.2)(np.argwhere(np.ones((16, 17, 15)))) < 0, 5, 0)
    labels = labels.reshape(16, 17, 15)
    alone = reconstruct(make_grid(labels, label=5, spacing=0.5, origin=3), network)
    mesh = reconstruct_labels(labels, network=network, spacing=0.5, origin=3)[5]
    assert mesh.vertices.dtype == alone.vertices.dtype
    assert len(mesh.faces) == len(alone.faces)
    ours, theirs = (np.unique(some.vertices, axis=0) for some in (mesh, alone))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert mesh.volume() == pytest.approx(alone.volume(), rel=1e-6)


@pytest.mark.parametrize(
    ("dtype", "low", "high"),
    [
        (np.int16, -5, 300),
        (np.uint64, 2**53 + 1, 2**53),
        (np.int64, -(2**63), 2**62 + 1),
        (np.float64, -1, 2**40),
    ],
)
def test_labels_of_any_type_are_compared_as_whole_numbers(dtype, low, high):
    labels = np.zeros((7, 6, 6), dtype)
    labels[2:4, 2:4, 2:4], labels[4:6, 2:4, 2:4] = low, high
    meshes = reconstruct_labels(labels, network=trilinear, factor=2, spacing=1)
    volumes = {label: mesh.volume() for label, mesh in meshes.items()}
    assert volumes == pytest.approx({low: 6, high: 6}, rel=0.1) and list(volumes) == sorted(volumes)
    assert list(reconstruct_labels(labels, iter([high]), trilinear, 2, spacing=1)) == [high]
    assert list(reconstruct_labels(labels, [0, low], trilinear, 2, spacing=1)) == sorted([0, low])


AS_DENSITIES = "choose what is above a value with --level if they are densities"
UNFIT = {
    "labels is 3: give all, or some labels such as 1,2,3": (IMAGES["noise"], 3),
    "labels are 1,001: give 1 to 1,000 at a time": (IMAGES["noise"], range(1001)),
    "labels is 1.5: give a whole number, -2^63 to 2^64 - 1": (IMAGES["noise"], [1, 1.5]),
    "no sample has the label 5: the labels are 0, 1, 2, 3": (IMAGES["noise"], [1, 5]),
    "every sample has the label 0: there is no surface": (np.zeros((4, 4, 4), int), "all"),
    f"a value is 0.5: labels are whole numbers; {AS_DENSITIES}": (IMAGES["noise"] / 2, "all"),
    "the values are more than 1,000 different whole numbers: choose some of them (--labels 1,2,3) "
    "if they are labels, or a --level if they are densities": (
        np.arange(11**3).reshape(11, 11, 11),
        "all",
    ),
}


@pytest.mark.parametrize("message", UNFIT)
def test_wrong_labels_and_values_that_are_none_are_one_line(message):
    with pytest.raises(OptionError if message.startswith("labels ") else GridError) as caught:
        reconstruct_labels(*UNFIT[message], trilinear)
    assert str(caught.value) == message


@pytest.fixture
def image(tmp_path, monkeypatch):
    """A turned NIfTI file with three labels and thick slices, in a folder to work in."""
    monkeypatch.chdir(tmp_path)
    labels = painted((18, 14, 6), (1, 1, 2.5), [ball((6, 6, 6), 4), ball((11, 7, 7), 4)])
    labels[labels == 2] = 12
    labels[0, 0] = 3
    affine = np.eye(4)
    affine[:3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, -1]]) @ np.diag([1, 1, 2.5])
    affine[:3, 3] = 10, -20, 30
    nibabel.save(nibabel.Nifti1Image(labels.astype(np.int16), affine), "three.nii.gz")
    return "three.nii.gz"


PLAIN = "--quality", "fast", "--threads", "1", "--factor", "2"


def test_the_command_writes_a_file_for_each_label(image, command):
    code, out, err = command("upsample", image, "organ.ply", "--labels", "all", "--json", *PLAIN)
    rows = json.loads(out)["labels"]
    assert code == 0 and [row["label"] for row in rows] == [1, 3, 12]
    assert "Note: solids of labels run out of the grid: closed along the border (3)\n" in err
    for row in rows:
        path = f"organ-{row['label']}.ply"
        mesh = trimesh.load(path, process=False)
        assert row["output"] == path and row["closed"] and mesh.is_watertight
        assert row["triangles"] == len(mesh.faces) and row["vertices"] == len(mesh.vertices)
        assert row["volume"] == pytest.approx(mesh.volume, rel=1e-5) and mesh.volume > 0
        assert f"{path}: label {row['label']}, {len(mesh.faces):,} triangles, " in err
    low, high = mesh.bounds  # of label 12, a ball in a turned grid
    np.testing.assert_allclose((low + high) / 2, (3, -9, 23), atol=0.5)


@pytest.mark.parametrize("suffix", [".glb", ".3mf"])
def test_one_file_holds_all_labels_as_parts(image, suffix, command):
    assert command("upsample", image, f"all{suffix}", "--labels", "1,12", *PLAIN)[0] == 0
    parts = trimesh.load(f"all{suffix}", process=False).geometry
    assert sorted(parts) == ["label 1", "label 12"]
    assert all(mesh.is_watertight and mesh.volume > 0 for mesh in parts.values())
    one, other = (set(map(bytes, mesh.vertices.astype(np.float32))) for mesh in parts.values())
    assert len(one & other) > 25  # the vertices of the wall


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("--simplify 0.1", "simplify 0.1"),
        ("--mesher sharp", "mesher 'sharp'"),
        ("--open", "open"),
        ("--save-field f.npz", "save-field"),
    ],
)
def test_options_that_would_tear_the_walls_are_refused(words, name, image, command):
    code, _, err = command("upsample", image, "a.ply", "--labels", "all", *words.split(), *PLAIN)
    assert (code, err.splitlines()[-1]) == (
        2,
        f"Error: {name} does not go with labels, which share their walls: leave it out, or mesh "
        "one label (--label)",
    )
    assert not Path("a-1.ply").exists()
