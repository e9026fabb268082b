"""Reports and viewers in headless Chromium: they open, turn, cut and switch, and ask for nothing.

The browser is the distribution's; Playwright only drives it.
"""

import shutil
from io import BytesIO

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import ball
from PIL import Image
from playwright.sync_api import Error, sync_playwright
from solids import wedge

from super_sdf.cli.main import cli

NAMES = ("chromium", "chromium-browser", "google-chrome")
WITHOUT_GPU = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE = 120_000  # milliseconds: without a GPU, on a busy machine
MARKUP = "<b>bold<img src=x onerror=document.title='ran'>"
FAST = ("--quality", "fast", "--factor", "2", "--spacing", "1", "--device", "cpu")
pytestmark = pytest.mark.graphics


@pytest.fixture(scope="module")
def browser():
    """The distribution's Chromium, without a window and drawing without a GPU."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.fail(f"no {' or '.join(NAMES)} on the PATH: apt-get install chromium")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(
            executable_path=found, args=["--no-sandbox", *WITHOUT_GPU]
        )
        yield running
        running.close()


@pytest.fixture
def visit(browser):
    """Open an address; return the page, which has what it asked for and complained of."""
    opened = []

    def go(address):
        page = browser.new_page(viewport={"width": 1000, "height": 900})
        page.set_default_timeout(PATIENCE)
        page.requested, page.complaints = [], []
        page.on("request", lambda request: page.requested.append(request.url))
        page.on("console", lambda message: page.complaints.append(message.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.goto(address)
        opened.append(page)
        return page

    yield go
    for page in opened:
        page.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The address of the page of one conversion."""
    folder = tmp_path_factory.mktemp("report")
    np.save(folder / "a.npy", wedge())
    files = [str(folder / name) for name in ("a.npy", "a.ply", "a.html")]
    words = ["upsample", *files[:2], *FAST, "--report", files[2]]
    assert CliRunner().invoke(cli, words).exit_code == 0
    return (folder / "a.html").as_uri()


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """The address of the page of a batch with its meshes beside it; one name is markup."""
    folder = tmp_path_factory.mktemp("batch")
    (folder / "in").mkdir()
    np.save(folder / "in" / f"{MARKUP}.npy", ball(12, 3.0).values)
    np.save(folder / "in" / "b.npy", ball(12, 4.0).values)
    np.save(folder / "in" / "bad.npy", np.ones((4, 4, 4)))
    where = [str(folder / name) for name in ("in", "out", "page & more.html")]
    words = ["batch", where[0], "--out", where[1], "--report", where[2], "--jobs", "1", *FAST]
    assert CliRunner().invoke(cli, words).exit_code == 1
    return (folder / "page & more.html").as_uri()


def pictures(page):
    """Return the pictures of all canvases, (height, width, 3), when they stand still."""
    page.locator("canvas").last.wait_for()
    page.wait_for_timeout(300)

    def take():
        shots = [canvas.screenshot() for canvas in page.locator("canvas").all()]
        return [np.array(Image.open(BytesIO(shot)).convert("RGB")).astype(int) for shot in shots]

    last, now = take(), take()
    while not all(map(np.array_equal, last, now)):
        last, now = now, take()
    return now


def silhouette(picture):
    """Return where a picture differs from its background, which is in the middle of its top."""
    return np.abs(picture - picture[4, picture.shape[1] // 2]).max(2) > 8


def overlap(one, other):
    """Return intersection over union of the silhouettes of two pictures."""
    one, other = silhouette(one), silhouette(other)
    return (one & other).sum() / (one | other).sum()


def changed(before, after):
    """Return the share of pixels that differ, for each canvas."""
    return [float((np.abs(a - b).max(2) > 8).mean()) for a, b in zip(before, after)]


def test_the_page_opens_with_two_views_and_asks_for_nothing(visit, report):
    page = visit(report)
    shots = pictures(page)
    assert len(shots) == 2 and page.title() == "a.ply"
    for shot in shots:
        shape = silhouette(shot)
        assert 0.1 < shape.mean() < 0.8 and len(np.unique(shot[shape], axis=0)) > 20
    assert overlap(*shots) > 0.9  # one camera
    assert page.requested == [report] and page.complaints == []
    with pytest.raises(Error, match="Failed to fetch"):  # the policy forbids it
        page.evaluate("fetch('http://127.0.0.1:9/')")
    assert any("Content Security Policy" in said for said in page.complaints)


def test_turning_one_view_turns_both_and_each_switch_changes_the_pictures_and_back(visit, report):
    page = visit(report)
    before = pictures(page)
    box = page.locator("canvas").last.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 320, box["y"] + 150, steps=4)
    page.mouse.up()
    turned = pictures(page)
    assert max(map(overlap, before, turned)) < 0.9 < overlap(*turned)
    page.get_by_role("button", name="Reset view").click()
    assert max(changed(before, pictures(page))) < 0.01
    for label in ("Normals", "Flat shading", "Wireframe"):
        control = page.get_by_label(label)
        control.click()
        assert max(changed(before, pictures(page))) > 0.02, label
        (page.get_by_label("Plain") if label == "Normals" else control).click()
        assert max(changed(before, pictures(page))) < 0.01, label
    page.get_by_label("Residuals").check()
    coarse = pictures(page)[1]  # cuts off edges: does not reach the balls there
    blue = (coarse[..., 2] > coarse[..., 0] + 80) & silhouette(coarse)
    assert blue.mean() > 0.01


def test_a_batch_loads_meshes_from_beside_the_page_and_names_are_text(visit, batch):
    page = visit(batch)
    names = page.locator(".name").all_inner_texts()
    assert f"{MARKUP}.ply" in [name.strip() for name in names]
    assert page.locator("img[src=x], .name b").count() == 0 and page.title().endswith("out")
    assert page.requested == [batch] and page.locator("canvas").count() == 0
    assert "failed" in page.locator(".file").first.inner_text()
    page.locator("summary", has_text="b.ply").click()
    assert all(0.1 < silhouette(shot).mean() < 0.9 for shot in pictures(page))
    (_, beside) = page.requested
    assert beside.startswith(batch.removesuffix(".html") + "-files/") and beside.endswith(".js")
    page.locator("summary", has_text=MARKUP).click()  # only one viewer is open at a time
    page.locator(".file", has_text=MARKUP).locator("canvas").first.wait_for()
    assert page.locator("canvas").count() == 2 and page.complaints == []
