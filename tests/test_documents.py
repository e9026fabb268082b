"""README, site and examples say and do what they say and do, of today, in short sentences."""

import importlib.util
import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from super_sdf.cli.main import cli

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


def name_of(path: Path) -> str:
    """Return the path of a page in the repository."""
    return path.relative_to(ROOT).as_posix()


def blocks(language: str, page: Path = README) -> list[str]:
    """Return a page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def command_lines(page: Path) -> list[str]:
    """Return the lines of a page's shell blocks."""
    return [line for block in blocks("(?:sh|text)", page) for line in block.splitlines()]


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
    first, second = blocks("sh")[:2]
    assert first.startswith("python3 -m venv .venv && ") and second.startswith("python3 -m venv")
    assert "super-sdf upsample examples/part.npz part.ply" in first
    assert second.rstrip().endswith("python -m pytest -n auto")
    assert README.read_text().index(first) < README.read_text().index("\n## ")  # at the top


def test_the_main_job_of_the_readme(tmp_path, monkeypatch):
    words = shlex.split(blocks("sh")[0].split("&&")[-1])
    monkeypatch.chdir(ROOT)
    words[words.index("part.ply")] = str(tmp_path / "part.ply")
    result = CliRunner().invoke(cli, words[1:])
    assert result.exit_code == 0, result.output
    mesh = trimesh.load(tmp_path / "part.ply")
    assert mesh.is_watertight and mesh.volume > 0
    off = 0.15  # millimetres, a tenth of the spacing: see examples/README.md
    assert (mesh.bounds[0] > -off).all()
    assert (mesh.bounds[1] < np.array([66.06, 73.45, 15.55]) + off).all()
    assert (ROOT / "examples" / "part.npz").stat().st_size < 600_000
    text = (ROOT / "examples" / "README.md").read_text()
    assert "trimesh" in text and "MIT" in text


@pytest.fixture
def grids(tmp_path, monkeypatch) -> None:
    """Write small files under the names of the examples, and stay in their folder."""
    import nibabel
    import nrrd

    monkeypatch.chdir(tmp_path)
    values = 0.5 * (np.linalg.norm(np.indices((13, 13, 13)) - 6.2, axis=0) - 4)
    np.save("field.npy", values)
    np.save("mask.npy", values < 0)
    np.savez("part.npz", values=values, spacing=0.5)
    np.savez("a.npz", values=values, spacing=0.5)
    (Path("grids") / "sub").mkdir(parents=True)
    np.savez("grids/sub/part.npz", values=values, spacing=0.5)
    labels = np.where(values < 0, np.where(np.indices(values.shape)[0] < 6, 1, 2), 0)
    nibabel.save(nibabel.Nifti1Image(labels.astype(np.int16), np.eye(4)), "labels.nii.gz")
    nrrd.write("ct.nrrd", (300 - 400 * np.tanh(values)).astype(np.float32))


@pytest.mark.parametrize("line", blocks("sh")[2].splitlines(), ids=lambda line: line[:45])
def test_the_examples_of_the_readme_run(line, grids):
    result = CliRunner().invoke(cli, shlex.split(line, comments=True)[1:])
    assert result.exit_code == 0, result.output


def test_the_python_of_the_readme_and_the_quick_start_runs(grids):
    for block in blocks("python") + blocks("python", ROOT / "docs" / "quickstart.md"):
        Path("field.ply").unlink(missing_ok=True)
        exec(compile(block, "README.md", "exec"), {})
        assert Path("field.ply").exists()


def test_the_python_of_the_page_on_other_tools_runs(grids):
    with_pyvista, with_xarray = blocks("python", ROOT / "docs" / "guides" / "tools.md")
    names: dict = {}
    exec(compile(with_pyvista, "tools.md", "exec"), names)
    points = trimesh.load("ball.ply").vertices - names["image"].center
    assert np.abs(np.linalg.norm(points, axis=1) - 1.2).max() < 0.01
    exec(compile(with_xarray, "tools.md", "exec"), names)
    points = names["mesh"].vertices - (12, 0, 0)
    assert np.abs(np.linalg.norm(points, axis=1) - 1.5).max() < 0.02


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_have_the_arguments_that_a_page_gives_them(page):
    """Files are not looked for; options and their values are checked."""
    for line in command_lines(page):
        words = shlex.split(line, comments=True)
        if words[:1] == ["super-sdf"]:
            command = cli.get_command(click.Context(cli), words[1])
            assert command, line
            for param in command.params:
                if isinstance(param.type, click.Path):
                    param.type.exists = False  # in this process of the tests alone
            command.make_context(words[1], words[2:])
        if words[:2] == ["python", "-m"] and words[2].startswith("export."):
            assert importlib.util.find_spec(words[2]), line
        if words[:3] == ["python", "-m", "lab"] and (ROOT / "lab").is_dir():
            assert (ROOT / "lab" / f"{words[3]}.py").exists(), line


def documented(heading: str) -> set[str]:
    """Return the keys in the first column of the tables below a heading of the page on JSON."""
    page = (ROOT / "docs" / "reference" / "json.md").read_text()
    section = page[page.index(f"## {heading}") :].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return set(re.findall(r"`(\w+)`", " ".join(rows)))


def printed(*words: str) -> dict:
    """Return the JSON that a command prints."""
    return json.loads(CliRunner().invoke(cli, [*words, "--json", "--quiet"]).stdout)


def test_the_keys_of_json_are_as_documented(grids):
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
    scenes = [trimesh.load_scene(path) for path in tmp_path.iterdir() if path.suffix != ".vdb"]
    assert all(part.is_watertight for scene in scenes for part in scene.geometry.values())


def test_the_tour_names_all_rooms_and_modules_that_are_there():
    tour = ROOT / "docs" / "develop" / "tour.md"
    linked = [tour.parent / link for link in re.findall(r"\]\(([^)]+)", tour.read_text())]
    assert all(path.is_file() for path in linked)
    package = ROOT / "src" / "super_sdf"
    rooms = {path.parent for path in package.glob("*/__init__.py")}
    assert rooms <= {path.resolve().parent for path in linked}
