"""Names and colours of labels, from tables as programs write them."""

import json
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import trimesh
from conftest import refusal

from super_sdf.errors import FileError
from super_sdf.labels.files import LabelName, read_names

TABLES = {
    "slicer.ctbl": "# Color table file\n0 Background 0 0 0 0\n1 liver 221 130 101 255\n"
    "5 left_kidney 185 102 83 255\n",
    "snap.txt": '# ITK-SNAP\n    0     0    0    0        0  0  0    "Clear Label"\n'
    '    1   221  130  101        1  1  1    "liver"\n'
    '    5   185  102   83        1  1  1    "left_kidney"\n',
    "FreeSurferColorLUT.txt": "#No. Label Name:       R   G   B   A\n\n1   liver   221 130 101 0\n"
    "5   left_kidney   185 102 83 0\n",
    "map.csv": "index,name,r,g,b\n1,liver,221,130,101\n5,left_kidney,185,102,83\n",
    "map.tsv": "1\tliver\t221\t130\t101\n5\tleft_kidney\t185\t102\t83\n",
}
LIVER, KIDNEY = LabelName("liver", (221, 130, 101)), LabelName("left_kidney", (185, 102, 83))


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", TABLES)
def test_tables_with_colours(name):
    Path(name).write_text(TABLES[name])
    names = read_names(name)
    assert (names[1], names[5]) == (LIVER, KIDNEY)


@pytest.mark.parametrize(
    "content",
    [
        {"1": "liver", "5": "left kidney"},
        {"liver": 1, "left kidney": 5},
        {"labels": {"background": 0, "liver": 1, "left kidney": 5}},
    ],
)
def test_names_in_json(content):
    Path("names.json").write_text(json.dumps(content))
    names = read_names("names.json")
    assert names[1] == LabelName("liver") and names[5] == LabelName("left kidney")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "[1]", "a.json cannot be read as a table of labels: it is no object of names"),
        ("a.json", '{"a": "b"}', "a.json cannot be read as a table of labels: 'a': 'b' is no label "
         "and name"),
        ("a.json", "{", "a.json cannot be read as a table of labels: Expecting property name"),
        ("a.txt", "liver\n", "a.txt names no label: give lines such as '1 liver'"),
        ("a.csv", b"\xff\xfe\x00", "a.csv cannot be read as a table of labels: 'utf-8' codec"),
    ],
)  # fmt: skip
def test_what_is_no_table(name, content, message):
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert refusal(FileError, read_names, name).startswith(message)
    assert refusal(FileError, read_names, "none.txt") == "none.txt does not exist"


@pytest.fixture
def image():
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


def test_files_and_parts_have_the_names(command, image):
    rows, err = convert(command, image, "o.stl", "all", "--names", "names.ctbl")
    assert [row["output"] for row in rows] == ["o-liver_co.stl", "o-left_kidney.stl"]
    assert [row["name"] for row in rows] == ["liver&co", "left_kidney"]
    assert [row["sample_volume"] for row in rows] == [180.0, 181.0]
    assert [row["components"] for row in rows] == [1, 2]
    assert "o-left_kidney.stl: left_kidney, " in err and " of its samples 181" in err
    for suffix in (".glb", ".3mf"):
        rows, _ = convert(command, image, f"o{suffix}", "all", "--names", "names.ctbl")
        parts = trimesh.load(f"o{suffix}", process=False).geometry
        assert sorted(parts) == ["left_kidney", "liver&co"]
    colour = trimesh.load("o.glb").geometry["liver&co"].visual.material.baseColorFactor
    linear = ((np.array([221, 130, 101]) / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(colour[:3] / 255, linear, atol=3e-3)
    with ZipFile("o.3mf") as archive:
        model = archive.read("3D/3dmodel.model").decode()
    assert '<base name="liver&amp;co" displaycolor="#DD8265"/>' in model
    assert '<object id="1" name="liver&amp;co" pid="3" pindex="0" type="model">' in model


def test_labels_are_chosen_by_name(command, image):
    rows, _ = convert(command, image, "o.ply", "left_kidney", "--names", "names.ctbl")
    assert [(row["label"], row["output"]) for row in rows] == [(5, "o-left_kidney.ply")]
    Path("same.csv").write_text("1,organ\n5,organ\n")
    rows, _ = convert(command, image, "o.glb", "all", "--names", "same.csv")
    assert [row["name"] for row in rows] == ["organ 1", "organ 5"]
    for table, names, ends in (
        ('{"1": "a/b", "5": "A:b"}', ["a/b", "A:b"], ["a_b-1", "A_b-5"]),
        ('{"1": "label 5"}', ["label 5 1", "label 5 5"], ["label_5_1", "5"]),
        ('{"1": "5"}', ["5", "label 5"], ["5-1", "5-5"]),
        ('{"1": "", "5": "\U0001f600"}', ["label 1", "\U0001f600"], ["1", "label"]),
    ):
        Path("t.json").write_text(table)
        rows, _ = convert(command, image, "t.stl", "all", "--names", "t.json", "--force")
        assert [row["name"] for row in rows] == names
        assert [row["output"] for row in rows] == [f"t-{end}.stl" for end in ends]
        volumes = [trimesh.load(row["output"]).volume for row in rows]
        np.testing.assert_allclose(volumes, [row["volume"] for row in rows], rtol=1e-4)
    rows, _ = convert(command, image, "p.ply", "all")
    assert [row["output"] for row in rows] == ["p-1.ply", "p-5.ply"]
    code, _, err = command("upsample", image, "o.ply", "--labels", "lung", "--names", "names.ctbl")
    assert (code, err) == (
        2,
        "Error: labels has 'lung': give numbers, or names of the table (Background, liver&co, "
        "left_kidney)\n",
    )
    code, _, err = command("upsample", image, "o.ply", "--names", "names.ctbl")
    assert (code, err) == (2, "Error: --names names.ctbl is for --labels: give that, too\n")
