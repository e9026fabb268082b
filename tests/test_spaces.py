"""Anatomical spaces: what files state, what meshes say, and the way from one to the other."""

from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import trimesh
from conftest import ball

from super_sdf import read_grid
from super_sdf.errors import OptionError

AFFINE = np.array([[0, -0.5, 0, 10.0], [0.5, 0, 0, -20], [0, 0, 0.5, 30], [0, 0, 0, 1]])
VALUES = ball(14, 4.0).values * np.float32(0.5)
LPS = np.diag([-1.0, -1, 1])
MIDDLE = AFFINE[:3, :3] @ np.full(3, 7 - 0.37) + AFFINE[:3, 3]  # of the ball, in RAS


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Work in a folder with the same ball as NIfTI in RAS, as NRRD and MetaImage in both."""
    monkeypatch.chdir(tmp_path)
    nibabel.save(nibabel.Nifti1Image(VALUES, AFFINE), "ball.nii")
    nibabel.save(nibabel.MGHImage(VALUES, AFFINE), "ball.mgz")
    for name, turn in (("right-anterior-superior", np.eye(3)), ("left-posterior-superior", LPS)):
        axes, corner = (turn @ AFFINE[:3, :3]).T, turn @ AFFINE[:3, 3]
        header = {"space": name, "space directions": axes, "space origin": corner}
        nrrd.write(f"{name}.nrrd", VALUES, header)
    matrix = " ".join(map(str, (LPS @ AFFINE[:3, :3]).T.ravel() / 0.5))
    offset = " ".join(map(str, LPS @ AFFINE[:3, 3]))
    Path("ball.mha").write_bytes(
        f"NDims = 3\nDimSize = 14 14 14\nElementType = MET_FLOAT\nElementSpacing = .5 .5 .5\n"
        f"TransformMatrix = {matrix}\nOffset = {offset}\nElementDataFile = LOCAL\n".encode()
        + VALUES.T.tobytes()
    )


FILES = {
    "ball.nii": "RAS",
    "ball.mgz": "RAS",
    "right-anterior-superior.nrrd": "RAS",
    "left-posterior-superior.nrrd": "LPS",
    "ball.mha": "LPS",
}


@pytest.mark.parametrize("name", FILES)
def test_a_grid_is_in_the_space_of_its_file_or_in_the_one_asked_for(name):
    for asked in (None, "RAS", "LPS"):
        grid = read_grid(name, space=asked)
        assert grid.space == (asked or FILES[name])
        where = grid.to_world(np.argwhere(grid.values == grid.low).mean(0))
        want = MIDDLE if grid.space == "RAS" else LPS @ MIDDLE
        np.testing.assert_allclose(where, want, atol=0.5)


@pytest.mark.parametrize("suffix, asked", [(".ply", None), (".stl", "LPS"), (".obj", "RAS")])
def test_meshes_lie_there_and_say_so(command, suffix, asked):
    words = ["--space", asked] if asked else []
    out = f"out{suffix}"
    assert command("upsample", "ball.nii", out, "--factor", 2, "-q", *words)[0] == 0
    want = MIDDLE if asked != "LPS" else LPS @ MIDDLE
    np.testing.assert_allclose(trimesh.load(out).bounds.mean(0), want, atol=0.02)
    head = Path(out).read_bytes()[:200]
    assert f"SPACE={asked or 'RAS'}".encode() in head
    code, said, _ = command("check", out, "ball.nii", "--no-faults", *words)
    assert code == 0 and "faults: none" in said


def test_what_states_no_space_has_none(command):
    np.savez("in.npz", values=VALUES, spacing=0.5)
    assert read_grid("in.npz").space is None
    assert command("upsample", "in.npz", "out.ply", "--factor", 2, "-q")[0] == 0
    assert b"SPACE" not in Path("out.ply").read_bytes()[:320]
    nrrd.write("plain.nrrd", VALUES, {"spacings": [0.5] * 3})
    nibabel.save(nibabel.Nifti1Image(VALUES, None), "plain.nii")
    for name in ("in.npz", "plain.nrrd", "plain.nii"):
        with pytest.raises(OptionError) as caught:
            read_grid(name, space="LPS")
        assert str(caught.value) == f"space is LPS: {name} states neither RAS nor LPS, leave it out"
    code, _, err = command("upsample", "in.npz", "a.ply", "--space", "LPS")
    assert code == 2 and err.endswith(
        "space is LPS: in.npz states neither RAS nor LPS, leave it out\n"
    )
