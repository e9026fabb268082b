"""README and examples say and do what they say and do."""

import importlib
import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from super_sdf.cli.main import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def blocks(language: str) -> list[str]:
    """Return README's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_first_two_commands_set_up_and_run_the_job_and_the_tests():
    first, second = blocks("sh")[:2]
    assert first.startswith("python3 -m venv .venv && ") and second.startswith("python3 -m venv")
    assert "super-sdf upsample examples/part.npz part.ply" in first
    assert second.rstrip().endswith("python -m pytest -n auto")
    assert README.index(first) < README.index("\n## ")  # at the top


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


@pytest.mark.parametrize("command", ["upsample", "batch", "check"])
def test_the_help_text_in_the_readme_is_what_the_command_prints(command):
    printed = CliRunner().invoke(cli, [command, "--help"], terminal_width=100).output
    usage = f"Usage: super-sdf {command}"
    shown = next(block for block in blocks("text") if block.startswith(usage))
    assert shown == printed.replace(f"cli {command}", f"super-sdf {command}")


def test_the_python_in_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values = np.linalg.norm(np.indices((16, 16, 16)) - 7.6, axis=0) - 5
    np.save("field.npy", values)
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), {})
    assert Path("field.ply").exists()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [example.name])
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out
    assert all(trimesh.load(path).is_watertight for path in tmp_path.iterdir())


def test_the_example_grid_is_small_and_named():
    grid = ROOT / "examples" / "part.npz"
    assert grid.stat().st_size < 600_000
    text = (ROOT / "examples" / "README.md").read_text()
    assert "trimesh" in text and "MIT" in text


def test_the_functions_on_the_tour_are_there():
    tour = (ROOT / "docs" / "tour.md").read_text()
    path = tour[tour.index("## Where a grid goes") : tour.index("## The rooms")]
    named = re.findall(r"`([a-z_.]+)\.(\w+)`", path)
    assert len(named) == 20
    for module, function in named:
        assert callable(getattr(importlib.import_module(f"super_sdf.{module}"), function))
