"""Fields with known surfaces, and a network whose answer is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from super_sdf import Mesh, SdfGrid, load_network, read_grid
from super_sdf.arrays import NEIGHBOURHOOD
from super_sdf.errors import SuperSdfError
from super_sdf.network import onnx
from super_sdf.network.onnx import ort
from super_sdf.truth import Solid

# How long an example takes says nothing on a busy machine.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


def trilinear(
    patches: np.ndarray, table: np.ndarray, voxels: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Stand in for the network: trilinear interpolation of the patch, exact on linear fields."""
    distance = np.abs(offsets[:, None] / 2 - NEIGHBOURHOOD)
    weights = np.clip(1 - distance, 0, None).prod(2)
    return (patches[voxels] @ weights.T).astype(np.float32)


def ball(n: int = 20, radius: float = 6.0, shape: tuple[int, int, int] | None = None) -> SdfGrid:
    """A ball in the middle of a grid of spacing 1, a little off the samples."""
    ijk = np.indices(shape or (n, n, n)).astype(np.float64)
    middle = np.array(ijk.shape[1:])[:, None, None, None] / 2 - 0.37
    values = np.linalg.norm(ijk - middle, axis=0) - radius
    return SdfGrid(values.astype(np.float32), (1.0, 1.0, 1.0))


def cut_ball() -> SdfGrid:
    """A ball that leaves its grid on three sides, with voxels inside that have no block."""
    ijk = np.indices((14, 15, 16)).astype(np.float64)
    return SdfGrid.trusted(np.linalg.norm(ijk - 2.3, axis=0) * 0.3 - 1.8, 0.3, (1.0, 2.0, 3.0))


def walled(values: np.ndarray) -> np.ndarray:
    """Make the outer two layers of a field as far outside as anything, so no surface leaves."""
    out = np.full_like(values, np.abs(values).max() + 1)
    out[2:-2, 2:-2, 2:-2] = values[2:-2, 2:-2, 2:-2]
    return out


def refusal(kind: type[Exception], call: Callable[..., Any], *given: Any, **options: Any) -> str:
    """Return the error of a kind, one line, that a call ends with."""
    with pytest.raises(kind) as caught:
        call(*given, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def said_of(path: str, **options: Any) -> str:
    """Return the one line with which a grid file is refused."""
    said = refusal(SuperSdfError, read_grid, path, **options)
    assert len(said) < 500
    return said


def is_manifold(mesh: Mesh) -> bool:
    """Say whether the triangles round each edge and each used vertex are one fan."""
    import igl

    faces = np.unique(mesh.faces, return_inverse=True)[1].reshape(-1, 3).astype(np.int64)
    return bool(igl.is_edge_manifold(faces)[0] and igl.is_vertex_manifold(faces).all())


@pytest.fixture(scope="session")
def fast():
    """Return the smallest network, on one thread."""
    return load_network("fast", threads=1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """Run the command line in this process; return exit code, stdout and stderr."""
    from super_sdf.cli.main import main

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["super-sdf", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture
def grid_folder(tmp_path, monkeypatch):
    """Work in a folder of its own with three good grids and a bad one below ``in``."""
    monkeypatch.chdir(tmp_path)
    Path("in/deep/er").mkdir(parents=True)
    np.save("in/a.npy", ball(12, 3.0).values)
    np.savez("in/deep/b.npz", values=ball(12, 3.5).values)
    np.save("in/deep/er/c.d.npy", ball(12, 4.0).values[:7])
    np.save("in/bad.npy", np.ones((4, 4, 4)))


@pytest.fixture
def cpu_build(monkeypatch):
    """Make onnxruntime one that was built without CUDA, whichever is installed."""
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["CPUExecutionProvider"])
    monkeypatch.setattr(onnx, "VERSION", f"onnxruntime {ort.__version__}")


def farthest(mesh: Mesh, other: Mesh) -> float:
    """Return the largest distance of ten points on every triangle of a mesh to another one."""
    shares = np.array([[i, j, 3 - i - j] for i in range(4) for j in range(4 - i)]) / 3
    points = np.einsum("pc,mcd->mpd", shares, mesh.vertices[mesh.faces].astype(np.float64))
    return float(Solid(other).distance(points.reshape(-1, 3)).max())
