"""Pictures hold what they should, and sections are of the right plane."""

import sys
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from conftest import ball, trilinear
from matplotlib.image import imread
from solids import cube, sphere

from lab import drawing
from lab.__main__ import main as lab
from lab.cross_sections import coarse_section, find_plane, fine_section, render_section
from lab.drawing import Panel, render_panels
from lab.surfaces import EMPTY
from super_sdf import Mesh, SdfGrid, upsample, write_mesh
from super_sdf.errors import DeviceError, FileError, OptionError

LONG_TITLE = "a_file_with_a_$long_{$_name_" * 5 + ".ply"  # and dollars that are no formulas
WHITE = np.full(3, 255)
# Of the faces of a cube that the default view shows, z up: to +x, -y and +z.
SHOWN = {"x": (255, 128, 128), "-y": (128, 0, 128), "z": (128, 128, 255)}


def pixels(path: Path) -> np.ndarray:
    return np.round(imread(path)[..., :3] * 255).astype(int)


def drawn(image: np.ndarray) -> np.ndarray:
    return (image != WHITE).any(-1)


def picture(folder: Path, *panels: Panel, **options: object) -> np.ndarray:
    target = folder / "picture.png"
    render_panels(panels, target, size=160, **options)
    return pixels(target)


def border(mask: np.ndarray) -> np.ndarray:
    return np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])


@pytest.mark.graphics
def test_every_mesh_is_drawn_whole_under_its_title(tmp_path: Path):
    image = picture(tmp_path, Panel(cube(), "a cube"), Panel(sphere(), LONG_TITLE))
    halves = np.array_split(drawn(image), 2, axis=1)
    assert all(half.mean() > 0.1 for half in halves)
    assert not border(drawn(image)).any()
    assert not drawn(image)[:, image.shape[1] // 2].any()
    for half in halves:  # a title, white, a mesh, white
        rows = half.any(1).astype(int)
        assert (np.diff(rows) == 1).sum() == 2


@pytest.mark.graphics
@pytest.mark.parametrize("factors", [(1, 1, 5), (5, 1, 1)])
def test_a_mesh_stays_clear_of_its_panel_s_edge(tmp_path: Path, factors: tuple[float, ...]):
    image = picture(tmp_path, Panel(Mesh(cube().vertices * factors, cube().faces)))
    gap = 160 // 30 + 1
    panel = drawn(image)[gap:-gap, gap:-gap]
    assert max(panel.shape) == 160
    assert panel.mean() > 0.2
    assert not border(panel).any()


@pytest.mark.graphics
def test_normal_colours_are_those_of_the_faces(tmp_path: Path):
    image = picture(tmp_path, Panel(cube()), colour="normal")
    colours, times = np.unique(image.reshape(-1, 3), axis=0, return_counts=True)
    common = {tuple(colour) for colour in colours[np.argsort(-times)[:4]].tolist()}
    assert common == {*SHOWN.values(), (255, 255, 255)}


@pytest.mark.graphics
@pytest.mark.parametrize("up", "xyz")
def test_the_chosen_axis_points_up(tmp_path: Path, up: str):
    image = picture(tmp_path, Panel(cube()), colour="normal", up=up)
    top = np.full(3, 128)
    top["xyz".index(up)] = 255
    rows = np.flatnonzero((image == top).all(-1).any(1))
    meshes = np.flatnonzero(drawn(image[: -int(image.shape[0] * 0.15)]).any(1))  # less the caption
    assert len(rows)
    assert rows[0] <= meshes[0] + 2
    assert rows[-1] < meshes.mean()


@pytest.mark.graphics
def test_an_error_picture_has_one_colour_bar(tmp_path: Path):
    shaded = picture(tmp_path, Panel(cube()), Panel(cube()))
    values = np.linspace(0, 1, 8)
    image = picture(tmp_path, Panel(cube(), values=values), Panel(cube()), colour="error", top=0.5)
    foot = image[shaded.shape[0] :]
    ends = matplotlib.colormaps[drawing.COLOUR_MAP]([0.02, 0.98])[:, :3] * 255
    for end in ends:
        assert (np.abs(foot - end).max(-1) < 8).any()
    assert not border(drawn(image)).any()
    assert drawn(foot).any(1).sum() > drawn(foot).any(1).argmax()  # a title, the bar, numbers


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--colour", "error"), "--colour error and --reference MESH go together"),
        (("--axis", "z"), "--axis does not apply to meshes: leave it out"),
    ],
)
def test_options_without_meaning_are_named_in_one_line(tmp_path, monkeypatch, capsys, words, said):
    write_mesh(cube(), tmp_path / "box.ply")
    target = str(tmp_path / "picture.png")
    monkeypatch.setattr(sys, "argv", ["lab", "render", str(tmp_path / "box.ply"), target, *words])
    assert lab() == 2
    err = capsys.readouterr().err
    assert said in err and err.startswith("Error: ") and err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["box.ply"]


def test_pictures_of_nothing_are_refused(tmp_path: Path):
    with pytest.raises(OptionError, match="no mesh has a face"):
        picture(tmp_path, Panel(EMPTY))


@pytest.mark.graphics
def test_a_picture_that_cannot_be_written_leaves_nothing(tmp_path: Path):
    with pytest.raises(FileError, match="cannot be written"):
        render_panels([Panel(cube())], tmp_path / "none" / "picture.png")
    picture(tmp_path, Panel(cube()))
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


def slope(axis: int) -> SdfGrid:
    """A plane, tilted, in a long grid off the origin; unlike on all axes."""
    ijk = np.indices((10, 12, 14)).astype(float)
    normal = np.roll([0.2, 0.5, np.sqrt(1 - 0.29)], axis)
    values = 0.5 * (np.tensordot(normal, ijk, 1) - normal @ [4.6, 5.7, 6.8])
    return SdfGrid.trusted(values.astype(np.float32), 0.5, (10.0, -20.0, 30.0))


def distance_to_slope(grid: SdfGrid, axis: int, points: list[np.ndarray]) -> np.ndarray:
    normal = np.roll([0.2, 0.5, np.sqrt(1 - 0.29)], axis)
    through = np.array(grid.origin) + 0.5 * np.array([4.6, 5.7, 6.8])
    return sum(n * (x - t) for n, x, t in zip(normal, points, through))


@pytest.mark.parametrize(("axis", "factor"), [(0, 4), (1, 2), (2, 4)])
def test_sections_hold_the_closed_form_at_their_places(axis: int, factor: int):
    grid = slope(axis)
    field = upsample(grid, trilinear, factor)
    index = 6
    cut = grid.origin[axis] + grid.spacing[axis] * index
    coarse = coarse_section(grid, "xyz"[axis], index)
    fine = fine_section(field, grid, "xyz"[axis], index)
    for section, share in ((coarse, 1), (fine, 1 / factor)):
        lines = [first + step * np.arange(count) for first, step, count
                 in zip(section.first, section.step, section.values.shape)]  # fmt: skip
        places = [*np.meshgrid(*lines, indexing="ij")]
        places.insert(axis, np.full(section.values.shape, cut))
        known = np.isfinite(section.values)
        expected = distance_to_slope(grid, axis, places)
        np.testing.assert_allclose(section.values[known], expected[known], atol=1e-4)
        assert known[np.abs(expected) < 0.5 * 0.5].all()
        assert section.step == pytest.approx((0.5 * share, 0.5 * share))
    assert np.isfinite(coarse.values).all()
    assert np.isnan(fine.values).any()


def test_the_plane_is_the_nearest_one_or_in_the_middle_of_the_surface():
    grid = SdfGrid.trusted(ball(20).values, 0.5, (0.0, 0.0, 10.0))
    for axis, at, plane in (("z", 12.2, 4), ("z", 12.3, 5), ("x", -0.25, 0), ("x", 9.74, 19)):
        assert find_plane(grid, axis, at) == plane
    values = ball(12, 3.0).values
    far = np.full((12, 12, 30), 50.0, np.float32)
    far[..., 14:26] = values  # the ball's middle is at 14 + 5.63
    assert find_plane(SdfGrid(far, 1.0), "z") in (19, 20)
    two = np.full((12, 12, 40), 50.0, np.float32)
    two[..., :12] = two[..., -12:] = values  # nothing in the middle of two balls
    assert (two[..., find_plane(SdfGrid(two, 1.0), "z")] <= 0).any()
    for place in (-1.0, 20.0, float("nan")):
        with pytest.raises(OptionError, match=rf"^at is {place:g}: .* from -0.5 to 19.5 along z$"):
            find_plane(ball(20), at=place)


def test_a_section_is_drawn_before_and_after(tmp_path: Path):
    grid, target = ball(), tmp_path / "section.png"
    field = upsample(grid, trilinear, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render_section(grid, field, target, "z", 0)  # no surface there
    assert drawn(pixels(target)).any()
    render_section(grid, field, target, "z", find_plane(grid))
    image = pixels(target)
    grey = (image == [0xC4] * 3).all(-1)
    left, right = np.array_split(grey, 2, axis=1)
    assert image.shape[1] == 1400
    assert right.mean() > 0.1 > left.mean()
    black = (image.max(-1) < 60).mean()
    assert black > 0.002
    assert not border(drawn(image)).any()


def test_without_opengl_a_picture_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(drawing, "DRAW", "import os; os.abort()")
    drawing.can_draw.cache_clear()
    with pytest.raises(
        DeviceError,
        match=r"^drawing meshes needs OpenGL, and VTK finds none here: on Debian and Ubuntu, "
        r"apt-get install libegl1 libgl1-mesa-dri$",
    ):
        render_panels([Panel(cube())], tmp_path / "a.png")
    drawing.can_draw.cache_clear()
    assert not list(tmp_path.iterdir())
