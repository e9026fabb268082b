"""Labels of an image in one run: closed meshes, shared walls, names, colours and volumes."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
from conftest import farthest, refusal, trilinear
from scipy.ndimage import gaussian_filter

from super_sdf import make_grid, reconstruct, reconstruct_labels
from super_sdf.check import check_mesh, examine_surface
from super_sdf.errors import FileError, GridError, OptionError, OutOfMemoryError
from super_sdf.labels import reconstruct as labelling
from super_sdf.labels.files import read_names
from super_sdf.labels.volumes import FAR, volume_notes
from super_sdf.truth import Solid


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
}


def corners_of(mesh):
    """Return the triangles of a mesh by the bytes of their corners, from the lowest corner on."""
    found = Counter()
    for triangle in mesh.vertices[mesh.faces]:
        corners = [corner.tobytes() for corner in triangle]
        first = corners.index(min(corners))
        found[tuple(corners[first:] + corners[:first])] += 1
    return found


@pytest.mark.parametrize("more", [{}, {"tolerance": 0.1}, {"keep_volume": True}])
@pytest.mark.parametrize("name, factor", [("noise", 4), *((name, 2) for name in IMAGES)])
def test_meshes_are_closed_and_share_their_walls(name, factor, more):
    labels, spacing = IMAGES[name], (1.0, 0.75, 2.5)
    meshes = reconstruct_labels(labels, "all", trilinear, factor, spacing=spacing, **more)
    assert list(meshes) == sorted(set(np.unique(labels)) - {0})
    triangles = {label: corners_of(mesh) for label, mesh in meshes.items()}
    seen = sum(triangles.values(), Counter())
    for label, mesh in meshes.items():
        assert examine_surface(mesh).faults() == []
        assert set(triangles[label].values()) == {1}
    for a, b, c in seen:  # no two labels are on the same side of a triangle, nor three beside it
        assert seen[a, b, c] == 1


@pytest.mark.parametrize("thickness, most", [(1, 0.35), (4, 2)])
def test_the_line_on_which_labels_meet_has_no_teeth(thickness, most):
    """A ball cut by a plane: a circle, of its own length."""
    middle, normal, radius = np.array([15.3, 14.8, 15.1]), np.array([2, 1, 2]) / 3, 11
    whole, spacing = ball(middle - 2 * normal, np.hypot(radius, 2)), (1, 1, thickness)
    solids = [lambda p: np.maximum(whole(p), (p - middle) @ normal), whole]
    labels = painted((30, 30, 32 // thickness), spacing, solids)
    one, other = map(corners_of, reconstruct_labels(labels, spacing=spacing, origin=0).values())
    wall = [corners for corners in one if (corners[0], corners[2], corners[1]) in other]
    edges = {(corners[n - 1], corners[n]) for corners in wall for n in range(3)}
    ends = [end for edge in edges if edge[::-1] not in edges for end in edge]
    ends = np.frombuffer(b"".join(ends), np.float32).reshape(-1, 2, 3) - middle
    away = np.hypot(ends @ normal, np.linalg.norm(np.cross(ends, normal), axis=-1) - radius)
    assert away.max() < most
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * radius, rel=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_smooth_noise_gives_manifolds_that_do_not_intersect(seed, fast):
    """Between the points that are measured an error may be a tenth larger."""
    noise = np.random.default_rng(seed).standard_normal((4, 8, 8, 8))
    labels = np.stack([gaussian_filter(one, 1.0) for one in noise]).argmax(0)
    plain = reconstruct_labels(labels, "all", fast, spacing=1.0)
    for more in ({"keep_volume": True}, {"tolerance": 0.05}):
        made = reconstruct_labels(labels, "all", fast, spacing=1.0, **more)
        for label, mesh in made.items():
            for some in (mesh, plain[label]):
                assert examine_surface(some).faults() == []
            if "tolerance" in more:
                assert len(mesh.faces) < 0.95 * len(plain[label].faces)
                assert max(farthest(mesh, plain[label]), farthest(plain[label], mesh)) <= 0.055
            else:
                assert mesh.volume() == pytest.approx((labels == label).sum(), rel=2e-3)


def test_without_pyfqmr_the_walls_stay_as_they_are(monkeypatch, image, command):
    monkeypatch.setattr(labelling, "find_spec", lambda name: None)
    code, _, err = command("upsample", image, "a.ply", "--labels", "all", "--json", *PLAIN)
    assert code == 0 and "Note: pyfqmr is not installed: no triangles are spared\n" in err


def test_what_does_not_fit_in_memory_is_refused():
    how = {"network": trilinear, "spacing": 1, "max_memory": 10**6}
    said = refusal(OutOfMemoryError, reconstruct_labels, IMAGES["no ground"], **how)
    assert said.startswith("meshing 8 labels in 210 samples, ") and said.endswith("(max_memory=)")


def test_a_label_beside_no_other_has_the_mesh_that_it_has_alone(fast):
    labels = np.where(ball((7.3, 8.1, 7.7), 4.2)(np.argwhere(np.ones((16, 17, 15)))) < 0, 5, 0)
    labels = labels.reshape(16, 17, 15)
    alone = reconstruct(make_grid(labels, label=5, spacing=0.5, origin=3), fast)
    mesh = reconstruct_labels(labels, network=fast, spacing=0.5, origin=3)[5]
    assert mesh.vertices.dtype == alone.vertices.dtype
    assert len(mesh.faces) < 0.8 * len(alone.faces)
    for one, other in ((mesh, alone), (alone, mesh)):
        assert Solid(one).distance(other.vertices).max() < 0.02 * 0.5
    assert mesh.volume() == pytest.approx(alone.volume(), rel=1e-3)


@pytest.mark.parametrize(
    ("dtype", "low", "high"),
    [(np.uint64, 2**53 + 1, 2**53), (np.int64, -(2**63), 2**62 + 1), (float, -1, 2**40)],
)  # fmt: skip
def test_labels_of_any_type_are_compared_as_whole_numbers(dtype, low, high):
    labels = np.zeros((7, 6, 6), dtype)
    labels[2:4, 2:4, 2:4], labels[4:6, 2:4, 2:4] = low, high
    meshes = reconstruct_labels(labels, network=trilinear, factor=2, spacing=1)
    volumes = {label: mesh.volume() for label, mesh in meshes.items()}
    assert volumes == pytest.approx({low: 6, high: 6}, rel=0.1) and list(volumes) == sorted(volumes)
    assert list(reconstruct_labels(labels, iter([high]), trilinear, 2, spacing=1)) == [high]
    assert list(reconstruct_labels(labels, [0, low], trilinear, 2, spacing=1)) == sorted([0, low])


UNFIT = {
    "labels is 3: give all, or some labels such as 1,2,3": (IMAGES["noise"], 3),
    "labels has 1,001 labels: give 1 to 1,000": (IMAGES["noise"], range(1001)),
    "labels is [1, 1.5]: give all, or some labels such as 1,2,3": (IMAGES["noise"], [1, 1.5]),
    "no sample has the label 5: the labels are 0, 1, 2, 3": (IMAGES["noise"], [1, 5]),
    "every sample has the label 0: there is no surface": (np.zeros((4, 4, 4), int), "all"),
    "a value is 0.5: labels are whole numbers; ": (IMAGES["noise"] / 2, "all"),
    "the values are more than 1,000 different whole numbers: ": (
        np.arange(11**3).reshape(11, 11, 11), "all"),
}  # fmt: skip


@pytest.mark.parametrize("factor", [0.9999999998, 0.988])
def test_labels_may_be_nearly_whole_and_unknown_in_places(factor, fast):
    """As nibabel stores them, and resampled atlases; the advice to choose one can be followed."""
    whole = nested() + 0.0
    stored = factor * whole + NOISE.normal(0, 1e-7, whole.shape)
    stored[0] = np.nan
    said = refusal(GridError, make_grid, stored, spacing=1)
    assert said.startswith("the values look like labels (-3, 0, 7, 9, 40): ")
    assert (make_grid(stored, spacing=1, label=7).values < 0).sum() == (whole == 7).sum()
    found, wanted = (reconstruct_labels(x, network=fast, spacing=1) for x in (stored, whole))
    assert found.keys() == wanted.keys()
    for label, mesh in found.items():
        assert np.array_equal(mesh.vertices, wanted[label].vertices)
        assert "outside all labels" in str(mesh.notes)


@pytest.mark.parametrize("message", UNFIT)
def test_wrong_labels_and_values_that_are_none_are_one_line(message):
    kind = OptionError if message.startswith("labels ") else GridError
    assert refusal(kind, reconstruct_labels, *UNFIT[message], trilinear).startswith(message)


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
        assert f"{path}: label {row['label']}, {len(mesh.faces):,} triangles, pieces: 1, " in err
        assert f" volume {row['volume'] / 1000:.6g} ml, of its voxels " in err  # NIfTI is in mm
    assert "off those of the samples: label 3 " in err
    low, high = mesh.bounds  # of label 12, a ball in a turned grid
    np.testing.assert_allclose((low + high) / 2, (3, -9, 23), atol=0.5)


@pytest.mark.parametrize("words", ["--triangles 9", "--mesher sharp", "--open", "--save-field f"])
def test_options_that_would_tear_the_walls_are_refused(words, image, command):
    code, _, err = command("upsample", image, "a.ply", "--labels", "all", *words.split(), *PLAIN)
    said = f"Error: {words.split()[0]} does not go with labels, which share their walls: "
    assert code == 2 and said in err and not Path("a-1.ply").exists()


TABLES = {
    "slicer.ctbl": "# Color table file\n0 Background 0 0 0 0\n1 liver 221 130 101 255\n"
    "5 left_kidney 185 102 83 255\n",
    "snap.txt": '# ITK-SNAP\n    0     0    0    0        0  0  0    "Clear Label"\n'
    '    1   221  130  101        1  1  1    "liver"\n'
    '    5   185  102   83        1  1  1    "left_kidney"\n',
    "FreeSurferColorLUT.txt": "#No. Label Name:       R   G   B   A\n\n1   liver   221 130 101 0\n"
    "5   left_kidney   185 102 83 0\n",
    "map.csv": "index,name,r,g,b\n1,liver,221,130,101\n5,left_kidney,185,102,83\n",
    "map.tsv": "1\tliver\t221\t130\t101\n5\tleft_kidney\t185\t102\t83\tmore\n",
    "last.csv": "ID,up,r,g,b,Name\n1,9,221,130,101,liver\n5,9,185,102,83,left_kidney\n",
    "quoted.csv": '"label","name"\n1;"liver";221;130;101\n5;left_kidney;185;102;83;of two\n',
}
LIVER, KIDNEY = ("liver", (221, 130, 101)), ("left_kidney", (185, 102, 83))


@pytest.mark.parametrize("name", TABLES)
def test_tables_with_colours(name, folder):
    Path(name).write_text(TABLES[name])
    names = read_names(name)
    assert (names[1], names[5]) == (LIVER, KIDNEY)


def test_names_without_colours(folder):
    one, other = {"1": "liver", "5": "left kidney"}, {"liver": 1, "left kidney": 5}
    lines = "1,liver\n5,left kidney,abdomen\n", "1 liver\n5 left kidney\n"
    contents = *lines, *map(json.dumps, (one, other, {"labels": {"background": 0, **other}}))
    for content in contents:
        name = "names.txt" if content in lines else "names.json"
        Path(name).write_text(content)
        names = read_names(name)
        assert names[1] == ("liver", None) and names[5] == ("left kidney", None)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b"[1]"),
        ("a.json", b'{"1": "liver",'),
        ("a.json", b'{"labels": {"1": {"2": "liver"}}}'),
        ("a.txt", b"liver\n"),
        ("a.csv", b"\xff\xfe\x00"),
    ],
)
def test_what_is_no_table(name, content, folder):
    Path(name).write_bytes(content)
    either = """lines such as 1 liver, or in .json {"1": "liver"}"""
    assert refusal(FileError, read_names, name) == f"{name} is no table of labels: give {either}"
    assert refusal(FileError, read_names, "none.txt") == "none.txt does not exist"


@pytest.fixture
def boxes(folder):
    """Two boxes that share a wall, and a small one apart, twice in label 5."""
    labels = np.zeros((16, 12, 12), np.uint8)
    labels[3:8, 3:9, 3:9], labels[8:13, 3:9, 3:9] = 1, 5
    labels[14, 1, 1] = 5
    np.savez("labels.npz", values=labels, spacing=(0.5, 1.0, 2.0), origin=0.0)
    Path("names.ctbl").write_text(TABLES["slicer.ctbl"].replace("liver", "liver&co"))
    return "labels.npz"


def convert(command, image, out, labels="all", *more):
    words = ("upsample", image, out, "--labels", labels, "--factor", 2, "--json", *more)
    code, said, err = command(*words)
    assert code == 0, err
    return json.loads(said)["labels"], err


def test_files_and_parts_have_the_names(command, boxes):
    rows, _ = convert(command, boxes, "o.stl", "all", "--names", "names.ctbl")
    assert [row["output"] for row in rows] == ["o-liver_co.stl", "o-left_kidney.stl"]
    assert [row["name"] for row in rows] == ["liver&co", "left_kidney"]
    assert [row["sample_volume"] for row in rows] == [180.0, 181.0]
    assert [row["components"] for row in rows] == [1, 2]
    convert(command, boxes, "o.glb", "all", "--names", "names.ctbl")
    parts = trimesh.load("o.glb").geometry
    assert sorted(parts) == ["left_kidney", "liver&co"]
    linear = ((np.array([221, 130, 101]) / 255 + 0.055) / 1.055) ** 2.4
    colour = parts["liver&co"].visual.material.baseColorFactor
    np.testing.assert_allclose(colour[:3] / 255, linear, atol=3e-3)


def test_labels_are_chosen_by_name(command, boxes):
    rows, _ = convert(command, boxes, "o.ply", "left_kidney", "--names", "names.ctbl")
    assert [(row["label"], row["output"]) for row in rows] == [(5, "o-left_kidney.ply")]
    for table, names, ends in (
        ('{"1": "a/b", "5": "A:b"}', ["a/b", "A:b"], ["a_b-1", "A_b-5"]),
        ('{"1": "label 5"}', ["label 5 1", "label 5 5"], ["label_5_1", "5"]),
        ('{"1": "5"}', ["5", "label 5"], ["5-1", "5-5"]),
        ('{"1": "", "5": "\U0001f600"}', ["label 1", "\U0001f600"], ["1", "label"]),
    ):
        Path("t.json").write_text(table)
        rows, _ = convert(command, boxes, "t.stl", "all", "--names", "t.json", "--force")
        assert [row["name"] for row in rows] == names
        assert [row["output"] for row in rows] == [f"t-{end}.stl" for end in ends]
    Path("two.csv").write_text("1,organ\n5,organ\n")
    rows, _ = convert(command, boxes, "two.ply", "organ", "--names", "two.csv")
    assert [row["label"] for row in rows] == [1, 5]
    said = command("upsample", boxes, "no.ply", "--label", "organ", "--names", "two.csv")[2]
    assert said == "Error: --label organ names 2 labels: give a number\n"
    run = "upsample", boxes, "one.ply", "--force", *PLAIN
    assert command(*run, "--label", 5)[0] == 0
    made = Path("one.ply").read_bytes()
    assert command(*run, "--label", "left_kidney", "--names", "names.ctbl")[0] == 0
    assert Path("one.ply").read_bytes() == made
    known = "(Background, liver&co, left_kidney)"
    for words, said in (
        (("--labels", "lung"), f"--labels has 'lung': give numbers, or names of the table {known}"),
        (("--label", "lung"), f"--label lung names 0 labels: give a number, or a name {known}"),
    ):
        run = "upsample", boxes, "o.ply", "--names", "names.ctbl", *words
        assert command(*run) == (2, "", f"Error: {said}\n")


SPACING = (1.5, 1.5, 4.0)
MASK = painted((18, 19, 20), (1, 1, 1), [ball((8.3, 9.1, 9.6), 6.7)]) > 0


def test_keep_volume_is_advised_where_it_helps():
    assert ["keep" in volume_notes({"a": x}, FAR)[0] for x in ((0.3, 2), (6, 8))] == [False, True]


def test_labels_have_the_volumes_of_their_samples_and_share_their_walls():
    labels = painted((42, 32, 12), SPACING, [ball((22, 24, 24), 16), ball((44, 24, 24), 11)])
    plain, kept = (
        reconstruct_labels(labels, spacing=SPACING, keep_volume=k) for k in (False, True)
    )
    for label, mesh in kept.items():
        volume = (labels == label).sum() * np.prod(SPACING)
        assert mesh.volume() == pytest.approx(volume, rel=2e-4)
        assert abs(plain[label].volume() - volume) > 2e-3 * volume
        grid = make_grid(labels, label=label, spacing=SPACING)
        assert check_mesh(mesh, grid).surface.faults() == []
    one, other = (set(map(bytes, mesh.vertices)) for mesh in kept.values())
    assert len(one & other) > 200  # the vertices of the wall


def test_volumes_on_sheared_axes_are_those_of_sheared_boxes(fast):
    sheared, more = [[1, 0, 0.6], [0, 1, 0], [0, 0, 0.8]], {"spacing": 1, "keep_volume": True}
    mesh = reconstruct_labels(MASK, "all", fast, direction=sheared, **more)[1]
    assert mesh.volume() == pytest.approx(0.8 * MASK.sum(), rel=1e-3)


def test_a_volume_that_stays_off_is_noted(tmp_path, command):
    np.save(tmp_path / "mask.npy", MASK)
    run = "upsample", tmp_path / "mask.npy", tmp_path / "mask.ply", "--spacing", 1
    for option, is_off in (((), False), (("--simplify", 0.2), True)):
        code, _, err = command(*run, "--keep-volume", "--force", *option)
        assert code == 0 and ("off those of the samples: the mesh " in err) == is_off


def test_what_has_no_volume_to_keep_is_refused(tmp_path, command):
    exact = 6 - np.linalg.norm(np.indices((18, 18, 18)) - 8.6, axis=0)
    np.save(tmp_path / "distance.npy", -exact)
    np.save(tmp_path / "mask.npy", MASK)
    said = "Error: --keep-volume is for closed meshes of masks and labels, the values are "
    for name, option in (("distance", ()), ("mask", ("--offset", "0.1")), ("mask", ("--open",))):
        run = "upsample", tmp_path / f"{name}.npy", tmp_path / "out.ply", "--keep-volume"
        code, _, err = command(*run, "--spacing", 1, *option)
        assert code == 2 and f"{said}{name}: leave it out, or --offset and --open" in err
        assert not (tmp_path / "out.ply").exists()
