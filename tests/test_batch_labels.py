"""Batches of label images: each case as by upsample, shared walls, resumed after a kill."""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
from batches import files, rows
from processes import start_command, wait_for_lines
from test_labels import corners_of

from super_sdf import load_network
from super_sdf.options import Options
from super_sdf.labels.files import convert_labels
from super_sdf.labels.names import read_names
from super_sdf.options import LABELS

CASES, SIDE = 20, 12
ORGANS = ("liver", "spleen", "left kidney", "aorta", "gallbladder")
QUICK = ("--quality", "fast", "--factor", 2)
ALL = ("--labels", "all", "--names", "organs.csv", *QUICK)
STL = ("batch", "cases", "--out", "out", "--format", "stl")


def write_case(number: int, seed: int) -> None:
    """Write a label image with five organs that touch; every fourth case has no gallbladder."""
    random = np.random.default_rng(seed)
    at = np.stack(np.indices((SIDE,) * 3), -1)
    middles = SIDE / 2 + 2 * random.normal(size=(len(ORGANS), 3)).clip(-1, 1)
    far = np.linalg.norm(at[..., None, :] - middles, axis=-1)
    labels = np.where(far.min(-1) < 3, far.argmin(-1) + 1, 0).astype(np.uint8)
    if number % 4 == 3:
        labels[labels == 5] = 0
    image = nibabel.Nifti1Image(labels, np.diag([1, 0.75, 2, 1]))
    nibabel.save(image, f"cases/case{number:02}.nii.gz")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Twenty cases, and below ``want`` what the conversion of each makes by itself."""
    here, before = tmp_path_factory.mktemp("cases"), Path.cwd()
    os.chdir(here)
    for folder in ("cases", "want"):
        Path(folder).mkdir()
    Path("organs.csv").write_text("\n".join(f"{n},{name}" for n, name in enumerate(ORGANS, 1)))
    network, names = load_network("fast", threads=1), read_names("organs.csv")
    for number in range(CASES):
        write_case(number, number)
        case, target = f"cases/case{number:02}.nii.gz", f"want/case{number:02}.stl"
        convert_labels(case, target, network, Options(factor=2), names=names)
    os.chdir(before)
    return here


@pytest.fixture(autouse=True)
def here(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("cases", "want"):
        shutil.copytree(made / name, name)
    shutil.copy(made / "organs.csv", "organs.csv")


def contents(folder):
    """Return the bytes of the meshes below a folder."""
    return {path.name: path.read_bytes() for path in Path(folder).rglob("[!.]*.stl")}


def test_each_case_has_the_files_of_upsample_and_a_row(command):
    code, _, err = command(*STL, *ALL)
    assert code == 0 and "20 done, 0 failed; 95 meshes closed, 0 open" in err
    assert contents("out") == contents("want")
    for number in (0, 3):
        words = (f"cases/case{number:02}.nii.gz", f"one{number}.stl", *ALL)
        code, out, _ = command("upsample", *words, "--json", "--quiet")
        single = json.loads(out)["labels"]
        row = next(row for row in rows() if row["out"] == f"case{number:02}-*.stl")
        assert [each["name"] for each in row["labels"]] == list(ORGANS[: 5 - (number == 3)])
        for ours, theirs in zip(row["labels"], single, strict=True):
            name, path = ours.pop("output"), theirs.pop("output")
            assert ours == theirs and Path("out", name).read_bytes() == Path(path).read_bytes()
            assert row["output"][name]["size"] == Path(path).stat().st_size
            assert ours.keys() >= {"volume", "sample_volume", "components", "closed"}
    assert command(*STL, *ALL)[2].startswith("nothing to do: 20 done before; 95 meshes closed")


def test_neighbours_have_neither_gap_nor_overlap():
    """Each triangle is on the rim, or twice: in two labels, in opposite directions."""
    for number in range(CASES):
        meshes = [trimesh.load(path) for path in sorted(Path("want").glob(f"case{number:02}-*"))]
        seen = sum(map(corners_of, meshes), Counter())
        assert len(meshes) in (4, 5) and set(seen.values()) == {1}
        turned = {min((a, c, b), (c, b, a), (b, a, c)) for a, b, c in seen}
        walls = seen.keys() & turned
        assert len(walls) > 50
        rim = b"".join(b"".join(triangle) for triangle in seen.keys() - turned)
        corners = np.frombuffer(rim, meshes[0].vertices.dtype).reshape(-1, 3, 3)
        around = trimesh.Trimesh(*trimesh.triangles.to_kwargs(corners).values())
        whole = sum(mesh.volume for mesh in meshes)
        assert around.volume == pytest.approx(whole, rel=1e-6)


def test_killed_on_the_way_it_goes_on(command):
    process = start_command(*STL, *ALL, "--jobs", 2, "--threads", 1)
    wait_for_lines(process, Path("out/report.jsonl"))
    process.kill()
    process.communicate()
    before = rows()
    assert len(before) > 1
    code, _, err = command(*STL, *ALL)
    assert code == 0 and f", {len(before)} done before; 95 meshes" in err
    assert rows()[: len(before)] == before and len(rows()) == CASES
    assert contents("out") == contents("want")
    assert not list(Path("out").glob(".*.part"))


def test_a_case_of_which_half_was_written_is_completed(command):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    Path("out").mkdir()
    for name in ("case00-liver.stl", "case00-aorta.stl"):
        shutil.copy(f"want/{name}", f"out/{name}")
    stale = Path(f"out/.case00-spleen.stl.{ended.pid}.part")
    others = Path(f"out/.case001-spleen.stl.{ended.pid}.part")
    for path in (stale, others):
        path.write_text("half")
    Path("out/.super-sdf-batch").write_text('"case00-*.stl"\n')
    words = ("batch", "cases/case01.nii.gz", "--out", "out", "--format", "stl", *ALL)
    assert command(*words)[0] == 0 and not stale.exists() and others.exists()
    some = (f"cases/case0{number}.nii.gz" for number in (0, 1))
    words = ("batch", *some, "--out", "out", "--format", "stl", *ALL)
    assert command(*words)[0] == 0 and len(contents("out")) == 10
    assert contents("out").items() <= contents("want").items()


def test_only_a_changed_case_is_made_again_and_files_that_are_left_are_named(command):
    for number in range(5, CASES):
        os.remove(f"cases/case{number:02}.nii.gz")
    command(*STL, *ALL)
    before = files()
    write_case(3, 20)
    image = nibabel.load("cases/case04.nii.gz")
    labels = np.asarray(image.dataobj)
    labels[labels == 5] = 0
    nibabel.save(nibabel.Nifti1Image(labels, image.affine), "cases/case04.nii.gz")
    code, _, err = command(*STL, *ALL)
    assert code == 0 and "2 done, 0 failed, 3 done before; 23 meshes" in err
    assert f"Warning: 1 have files of labels from other runs: see {Path('out/report.jsonl')}" in err
    again = {name for name, time in files().items() if before.get(name) != time}
    assert {name[:6] for name in again - {"report.jsonl"}} == {"case03", "case04"}
    beside = {row["out"]: row["beside"] for row in rows()[-2:]}
    assert beside == {"case03-*.stl": [], "case04-*.stl": ["case04-gallbladder.stl"]}


def test_files_that_no_batch_made_are_kept_and_all_of_a_case_is_written_or_nothing(command):
    words = ("batch", "cases/case00.nii.gz", "--out", "out", "--format", "stl", *ALL)
    Path("out").mkdir()
    Path("out/case00-spleen.stl").write_text("mine")
    code, _, err = command(*words)
    path = Path("out/case00-spleen.stl")
    reason = f"{path} exists and is not what this batch makes: remove it or use --force"
    assert code == 1 and f"Failed: cases/case00.nii.gz: {reason}\n" in err
    assert sorted(files()) == ["case00-spleen.stl", "report.jsonl"] and path.read_text() == "mine"
    assert command(*words, "--force")[0] == 0 and len(files()) == 6
    path.write_text("mine")
    code, _, err = command(*words)
    reason = f"{path} exists and was changed after a batch made it: remove it or use --force"
    assert code == 1 and f"Failed: cases/case00.nii.gz: {reason}\n" in err and "1 refused" in err


def test_other_labels_and_options_are_said_before_the_work(command):
    words = ("batch", "cases/case00.nii.gz", "cases/case03.nii.gz", "--out", "out")
    words += ("--names", "organs.csv", "--format", "stl", *QUICK[:2])
    listed = ("--labels", "liver,gallbladder")
    assert command(*words, *listed)[0] == 0
    assert [row["asked"]["labels"] for row in rows()] == [[1, 5], [1, 5]]
    words, note = (*words, "--labels", "spleen", *QUICK[2:]), "these changed: factor, labels"
    _, out, err = command(*words, "--dry-run", "--json")
    assert json.loads(out)["made_again"] == {"outputs": 2, "options": ["factor", "labels"]}
    assert err.startswith(f"Note: 2 are made again, since {note}\n2 to do, 0 done before")
    _, out, err = command(*words, "--json")
    assert json.loads(out)["made_again"] == {"outputs": 2, "options": ["factor", "labels"]}
    assert err.startswith(f"Note: 2 are made again, since {note}\n")
    assert len(files()) == 6 and "Warning: 2 have files of labels from other runs" in err
    code, _, err = command(*words[:-4], *listed, *QUICK[2:])  # the batch's own, of other options
    assert code == 0 and "made again, since these changed: labels\n" in err
    Path("organs.csv").write_text("1,liver\n5,gallbladder\n2,milt\n")
    assert "since these changed: names\n" in command(*words[:-4], *listed, *QUICK[2:])[2]
    assert (
        "since these changed: model, network\n"
        in command(*words[:-6], "--quality", "base", *listed, *QUICK[2:], "--dry-run")[2]
    )


def test_a_listed_label_that_a_case_lacks_is_a_note(command):
    words = ("--names", "organs.csv", "--labels", "liver,gallbladder", *QUICK)
    note = "no sample has a label that was asked for: gallbladder"
    code, out, err = command("upsample", "cases/case03.nii.gz", "one.stl", *words, "--json")
    lacks = [{"label": 5, "name": "gallbladder"}]
    assert code == 0 and f"Note: {note}\n" in err and json.loads(out)["missing"] == lacks
    assert sorted(Path().glob("one*")) == [Path("one-liver.stl")]
    images = [f"cases/case0{number}.nii.gz" for number in (2, 3)]
    code, _, err = command("batch", *images, "--out", "out", "--format", "stl", *words)
    assert code == 0 and "Note: 1 lack labels that were asked for: see " in err
    assert {row["out"]: row["missing"] for row in rows()} == {
        "case02-*.stl": [],
        "case03-*.stl": lacks,
    }
    words = ("--labels", "5", *QUICK)
    reason = "no sample has the label 5: the labels are 0, 1, 2, 3, 4"
    assert command("upsample", images[1], "two.stl", *words)[2] == f"Error: {reason}\n"
    _, _, err = command("batch", images[1], "--out", "two", *words)
    assert f"Failed: {images[1]}: {reason}\n" in err


def test_a_format_with_parts_has_a_file_a_case_and_lists_name_labels(command):
    entries = [
        {"in": "cases/case00.nii.gz", "out": "x/a.3mf", "labels": ["liver", 2]},
        {"in": "cases/case01.nii.gz", "labels": "all"},
        {"in": "cases/case01.nii.gz", "label": 2},
        {"in": "cases/case02.nii.gz", "labels": [4], "out": "b.off"},
    ]
    Path("list.jsonl").write_text("\n".join(map(json.dumps, entries)))
    words = ("batch", "list.jsonl", "--names", "organs.csv", "--format", "glb", *QUICK)
    code, _, err = command(*words, "--out", "out")
    assert code == 0 and "4 done, 0 failed; 9 meshes closed, 0 open" in err
    made = ["b-aorta.off", "cases/case01-label2.glb", "cases/case01.glb", "x/a.3mf"]
    assert sorted(files()) == sorted([*made, "report.jsonl"])
    assert set(trimesh.load("out/x/a.3mf").geometry) == {"liver", "spleen"}
    assert "nothing to do: 4 done before; 9 meshes" in command(*words, "--out", "out")[2]
    command("upsample", "cases/case01.nii.gz", "one.glb", *ALL)
    assert Path("out/cases/case01.glb").read_bytes() == Path("one.glb").read_bytes()
    code, _, err = command(*words, "--out", "there", "--cluster", "local", "--jobs", 1)
    assert code == 0, err
    for name in made:
        assert Path("there", name).read_bytes() == Path("out", name).read_bytes()


WALLS = (
    "does not go with labels, which share their walls: leave it out, or mesh one label (--label)"
)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--labels", "all", "--check"), f"check {WALLS}"),
        (("--labels", "all", "--report", "p.html"), f"report {WALLS}"),
        (("--labels", "all", "--simplify", 0.1), f"simplify 0.1 {WALLS}"),
        (("--labels", "all", "--label", 2), f"label 2 {WALLS}"),
        (("--names", "organs.csv"), "--names organs.csv is for --labels: give that, too"),
        (
            ("--labels", "lung"),
            "labels has 'lung': give numbers, or names of the table (none without --names)",
        ),
        (
            ("list.jsonl", "--names", "organs.csv"),
            "list.jsonl, line 1: labels has 'lung': give numbers, or names of the table "
            "(liver, spleen, left kidney, aorta, gallbladder)",
        ),
        (("more.jsonl",), f"more.jsonl, line 1: cap False {WALLS}".replace("cap False", "open")),
        (
            ("most.jsonl",),
            "most.jsonl, line 1: 'labels' is 3: give all, or some labels such as 1,2,3",
        ),
    ],
)
def test_what_does_not_go_with_labels_is_refused_before_the_work(words, line, command):
    entry = '{"in": "cases/case00.nii.gz", "labels": '
    Path("list.jsonl").write_text(f'{entry}["lung"]}}')
    Path("more.jsonl").write_text(f'{entry}"all", "cap": false}}')
    Path("most.jsonl").write_text(f"{entry}3}}")
    code, out, err = command("batch", "cases", "--out", "out", *words)
    assert (code, out, err.splitlines()[-1]) == (2, "", f"Error: {line}")
    assert not Path("out").exists() and "labels" in LABELS


def test_a_link_in_place_of_a_mesh_is_not_followed(command):
    Path("out").mkdir()
    Path("out/case00-liver.stl").symlink_to("../cases/case01.nii.gz")
    before = Path("cases/case01.nii.gz").read_bytes()
    run = "batch", "cases/case00.nii.gz", "cases/case01.nii.gz", "--out", "out", "--format", "stl"
    code, _, err = command(*run, *ALL, "--force")
    assert code == 1 and "out/case00-liver.stl is a link: remove it\n" in err
    assert Path("cases/case01.nii.gz").read_bytes() == before
    assert not list(Path("out").glob("case00-[!l]*"))


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_two_inputs_that_make_the_same_file_are_not_lost(command, force):
    lines = (
        {"in": f"cases/case0{n}.nii.gz", "out": out} for n, out in ((0, "a-1.stl"), (1, "a.stl"))
    )
    more = {"label": 1}, {"labels": "all"}
    text = "\n".join(json.dumps({**line, **each}) for line, each in zip(lines, more))
    Path("list.jsonl").write_text(text)
    run = "batch", "list.jsonl", "--out", "out", *QUICK, "--jobs", 1
    code, _, err = command(*run, *force)
    assert (
        code == 1 and "was written while this batch ran: give its inputs other names (out)" in err
    )
    assert "1 done, 1 failed" in err
