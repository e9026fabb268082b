"""How fast the page of a large batch opens, in headless Chromium without a GPU.

    python -m benchmarks.report_page [--files 500] [--runs 5]     # needs the extra test

The rows have the facts of a real conversion (examples/part.npz, factor 2) and thumbnails that were
drawn of the mesh, turned; one in twenty failed. The meshes lie beside the page. Printed are the
size of the page and the median time until it is drawn, and until the views of a row are drawn after
a click on it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from super_sdf import Mesh, load_network
from super_sdf.convert import ConvertOptions, convert
from super_sdf.pages.entries import Entry, entry_of, entry_of_report
from super_sdf.pages.html import make_page, write_page
from super_sdf.pages.items import Item, item_of_files, write_item
from super_sdf.pages.meshes import reduced, thumbnail
from super_sdf.truth.mesh_files import read_mesh

GRID = Path("examples/part.npz")
THUMBNAILS = 20  # that differ
NAMES = ("chromium", "chromium-browser", "google-chrome")
WITHOUT_GPU = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
DRAWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def turned(mesh: Mesh, angle: float) -> Mesh:
    """Return a mesh turned about z."""
    c, s = np.cos(angle), np.sin(angle)
    return mesh.transformed(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.zeros(3))


def convert_once(folder: Path) -> tuple[dict[str, Any], Item, list[str | None]]:
    """Convert the example; return its report, its item and thumbnails."""
    target = folder / "part.ply"
    done = convert(GRID, target, load_network(device="cpu"), ConvertOptions(factor=2))
    item = item_of_files(target, GRID, ConvertOptions())
    mesh = reduced(read_mesh(target), 20_000)
    angles = np.linspace(0, 2 * np.pi, THUMBNAILS, endpoint=False)
    report = {**done.report(), "seconds": done.seconds, "input": str(GRID)}
    return report, item, [thumbnail(turned(mesh, angle)) for angle in angles]


def make_entries(
    count: int, report: dict[str, Any], item: Item, pictures: list[str | None]
) -> list[Entry]:
    """Return the rows of the page; one in twenty failed."""
    rows = []
    for number in range(count):
        name = f"assembly-{number // 50:02}/part-{number:04}.ply"
        if number % 20 == 0:
            reason = "every value is 1: a constant field has no surface"
            rows.append(entry_of(name, "failed", reason=reason))
            continue
        row = entry_of_report(name, {**report, "output": name}, item)
        meshes = f"page-files/{number:04}.js"
        rows.append(
            row
            | {"id": f"{number:04}", "meshes": meshes, "thumbnail": pictures[number % THUMBNAILS]}
        )
    return rows


def write_files(folder: Path, count: int) -> Path:
    """Write the page and the meshes beside it; return the page."""
    report, item, pictures = convert_once(folder)
    page, beside = folder / "page.html", folder / "page-files"
    beside.mkdir()
    entries = make_entries(count, report, item, pictures)
    for entry in entries:
        if entry["meshes"]:
            write_item(item, folder / entry["meshes"])
    known = {"title": f"{count} files", "lead": "", "alert": "", "summary": [], "notes": []}
    write_page(make_page({**known, "files": entries}, beside=True), page)
    return page


def open_once(browser: Browser, page: Path, count: int) -> tuple[float, float]:
    """Return the seconds until the page is drawn, and then until a row's views are."""
    tab = browser.new_page(viewport={"width": 1280, "height": 900})
    start = time.perf_counter()
    tab.goto(page.as_uri())
    tab.evaluate(DRAWN)
    opened = time.perf_counter() - start
    assert tab.locator(".file").count() == count
    start = time.perf_counter()
    tab.locator(".file.ok summary").first.click()
    tab.locator("canvas").nth(1).wait_for()
    tab.evaluate(DRAWN)
    shown = time.perf_counter() - start
    tab.close()
    return opened, shown


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--files", type=int, default=500)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        raise SystemExit(f"no {' or '.join(NAMES)} on the PATH: apt-get install chromium")
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = write_files(Path(folder), options.files)
        browser = playwright.chromium.launch(executable_path=found, args=WITHOUT_GPU)
        times = [open_once(browser, page, options.files) for _ in range(options.runs)]
        opened, shown = zip(*times)
        figures = {
            "files": options.files,
            "page_megabytes": round(page.stat().st_size / 1e6, 2),
            "seconds_to_open": round(statistics.median(opened), 3),
            "slowest": round(max(opened), 3),
            "seconds_to_show_a_row": round(statistics.median(shown), 3),
        }
        print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
