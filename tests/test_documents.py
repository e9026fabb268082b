"""README, site and examples say and do what they say and do, of today, in short sentences."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from super_sdf.cli.main import cli
from super_sdf.options import MESH_FORMATS

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
CARDS = sorted((ROOT / "src" / "super_sdf" / "models").glob("*.md"))
PAGES = [*sorted(ROOT.glob("*.md")), ROOT / "examples" / "README.md", *CARDS,
         *sorted((ROOT / "docs").rglob("*.md"))]  # fmt: skip
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# Documents speak of today: what was, and what it was like, is in the history of the repository.
HISTORY = (
    r"of before|earlier|\bolder|no longer|\bany ?more|formerly|previous(ly)?\b|used to be|so far\b"
    r"|(now|since|until) (then|version)|with \w+ blocks|in the version of"
)
LONGEST = 30  # words of a sentence
RE = re.MULTILINE | re.DOTALL
# What pages show and the test of their blocks leaves out, and where it runs, or why it does not.
LEFT_OUT = {
    r"-m venv|pip |pytest|ruff": "in .ci/run, which installs and tests",
    r"python -m (lab|export)|neural_field": "in .ci/nightly, in small: PyTorch, hours",
    r"gmsh|plate\.|pytetwild": "in .ci/nightly: examples/tools/tetrahedra.sh is docs/jobs/cad.md",
    r"dask |--cluster": "needs other machines: tests/test_cluster.py starts workers",
    r"--device cuda": "needs a GPU",
    r"paraview|bpy\.|/path/to|getargspec": "needs ParaView or Blender: tests/test_plugins.py",
    r"docker": "needs Docker",
}


def name_of(path: Path) -> str:
    """Return the path of a page in the repository."""
    return path.relative_to(ROOT).as_posix()


def sentences(page: Path) -> list[str]:
    """Return the sentences of a page: of paragraphs, items of lists and cells of tables."""
    text = re.sub(r"<!-- figures.*?<!-- /figures -->", "0", page.read_text(), flags=re.DOTALL)
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", text)  # of links, what is shown
    text = re.sub(r"^( *[-*] |\d+\. |\||#)", r"\n\n\1", text, flags=re.MULTILINE)
    parts = [part for line in re.split(r"\n\s*\n", text) for part in line.split("|")]
    ends = r"(?<=[.?!])[\"*)]*\s+(?=[\"(*]*[A-Z`-])"
    return [sentence for part in parts for sentence in re.split(ends, " ".join(part.split()))]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_are_short_and_of_today(page):
    long = [text for text in sentences(page) if len(text.split()) > LONGEST]
    past = [text for text in sentences(page) if re.search(HISTORY, text, re.IGNORECASE)]
    assert not long and not past


def test_the_readme_and_the_cards_are_short_and_its_first_commands_run_the_job_and_the_tests():
    assert len(README.read_text().splitlines()) <= 120
    assert all(len(card.read_text().splitlines()) <= 90 for card in CARDS)
    links = re.findall(r"\]\(([^)#]+)", README.read_text())
    assert len(links) > 25 and all((ROOT / link).exists() for link in links)
    first, second = re.findall(r"^```sh\n(.*?)^```", README.read_text(), RE)[:2]
    assert first.startswith("python3 -m venv .venv && ") and second.startswith("python3 -m venv")
    assert "super-sdf upsample examples/part.npz part.ply" in first
    assert second.rstrip().endswith("python -m pytest -n auto")
    assert README.read_text().index(first) < README.read_text().index("\n## ")  # at the top
    assert (ROOT / "examples" / "part.npz").stat().st_size < 600_000
    assert "MIT licence, Copyright (c) 2023" in (ROOT / "examples" / "README.md").read_text()


@pytest.fixture
def inputs(tmp_path, monkeypatch) -> None:
    """Write small files under the names that pages give to those of a reader, in a folder."""
    import nibabel
    import nrrd

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", bool)
    Path("examples").symlink_to(ROOT / "examples")
    for folder in ("grids/sub", "scans/sub", "cases", "frames"):
        Path(folder).mkdir(parents=True)
    voxels = np.linalg.norm(np.indices((13, 13, 13)) - 6.2, axis=0)
    values, seen = 0.5 * (voxels - 4), voxels > 1.5
    for name in ("part", "grids/sub/part", "scans/sub/a", "a"):
        np.savez(name, values=values, spacing=0.5)
    arrays = {"field": values, "volume": values, "mask": values < 0, "scan": values < 0}
    arrays |= {"siren": np.tanh(values), "weight": seen}
    arrays["tsdf"] = np.where(seen, 0.02 * values.clip(-1.5, 1.5), -1000)
    for name, array in arrays.items():
        np.save(name, array)
    Path("more.txt").write_text("a.npz\n")
    labels = np.where(values < 0, np.array([1, 5, 6])[np.arange(13) // 5, None, None], 0)
    for name in ("labels", "case", "cases/a"):
        image = nibabel.Nifti1Image(labels.astype(np.int16), np.eye(4))
        nibabel.save(image, f"{name}.nii.gz")
    for name in ("organs.ctbl", "labels.ctbl"):
        Path(name).write_text("1 liver 221 130 101 255\n5 spleen 157 108 162 255\n")
    nrrd.write("ct.nrrd", (300 - 400 * np.tanh(values)).astype(np.float32))
    trimesh.creation.icosphere(3).export("mesh.stl")
    for name, written in (("splash", "two-balls"), ("smoke", "density"), ("frames/a", "density")):
        Path(f"{name}.vdb").symlink_to(ROOT / "tests" / "data" / f"{written}.vdb")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_blocks_of_a_page_run(page, inputs):
    """In order; of ``super-sdf`` lines that are left out, the options are checked."""
    names: dict = {}
    for language, block in re.findall(r"^ *```(sh|python)\n(.*?)^ *```", page.read_text(), RE):
        for step in [block] if language == "python" else block.splitlines():
            words = shlex.split(step, comments=True) if language == "sh" else []
            left_out = any(re.search(pattern, step) for pattern in LEFT_OUT)
            if words[:1] == ["super-sdf"] and left_out:
                cli.get_command(click.Context(cli), words[1]).make_context(words[1], words[2:])
            elif words[:1] == ["super-sdf"]:
                result = CliRunner().invoke(cli, words[1:])
                assert result.exit_code == 0, f"{step}\n{result.output}"
            elif not left_out and words:
                assert words[0] == "python", step
                subprocess.run([sys.executable, *words[1:]], check=True)
            elif not left_out:
                exec(compile(block, page.name, "exec"), names)
    assert_closed(Path())


def assert_closed(folder: Path) -> None:
    """Assert that each part of each mesh below a folder is closed."""
    paths = [path for path in folder.rglob("*.*") if path.suffix[1:] in MESH_FORMATS]
    scenes = [trimesh.load_scene(path) for path in paths]
    assert all(part.is_watertight for scene in scenes for part in scene.geometry.values())


def documented(heading: str) -> set[str]:
    """Return the keys in the first column of the tables below a heading of the page on JSON."""
    page = (ROOT / "docs" / "reference" / "json.md").read_text()
    section = page[page.index(f"## {heading}") :].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return set(re.findall(r"`(\w+)`", " ".join(rows)))


def printed(*words: str) -> dict:
    """Return the JSON that a command prints."""
    return json.loads(CliRunner().invoke(cli, [*words, "--json", "--quiet"]).stdout)


def test_the_keys_of_json_are_as_documented(inputs):
    assert set(printed("upsample", "part.npz", "part.ply")) == documented("upsample")
    assert set(printed("check", "part.ply", "part.npz")) == documented("check")
    summary = printed("batch", "a.npz", "--out", "meshes")
    page = (ROOT / "docs" / "reference" / "json.md").read_text()
    assert all(f"`{key}`" in page for key in summary)
    row = json.loads(Path("meshes/report.jsonl").read_text())
    assert documented("batch") <= set(row) <= documented("batch") | documented("upsample")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [example.name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(example), run_name="__main__")
    monkeypatch.setattr(sys, "argv", [example.name])
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out.startswith("usage: ")
    assert_closed(tmp_path)


def test_the_tour_names_all_rooms_and_modules_that_are_there():
    tour = ROOT / "docs" / "develop" / "tour.md"
    linked = [tour.parent / link for link in re.findall(r"\]\(([^)]+)", tour.read_text())]
    assert all(path.is_file() for path in linked)
    package = ROOT / "src" / "super_sdf"
    rooms = {path.parent for path in package.glob("*/__init__.py")}
    assert rooms <= {path.resolve().parent for path in linked}
