"""What the page of a batch shows of its meshes: a file each in the folder beside the page."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from ..files.output import naming
from ..pages.items import Item, read_head, write_item
from .fingerprint import Fingerprint


def items_folder(page: Path) -> Path:
    """Return the folder beside a page: OUT-files beside OUT.html."""
    return page.with_name(f"{page.stem}-files")


def item_name(target: str) -> str:
    """Return the name of an item by its output: 16 hexadecimal digits."""
    return hashlib.sha256(target.encode("utf-8", "surrogatepass")).hexdigest()[:16]


class Items:
    """The items of the meshes of a batch, in a folder that is made when it is needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, target: str) -> Path:
        """Return the file of the item of an output."""
        return self.folder / f"{item_name(target)}.js"

    def add(self, item: Item, target: str, mesh_print: Fingerprint) -> None:
        """Write the item of an output whose mesh has this fingerprint."""
        item.made_of = mesh_print["sha256"]
        with naming(self.folder):
            self.folder.mkdir(exist_ok=True)
        write_item(item, self.path(target))

    def find(self, target: str, mesh_print: Fingerprint) -> Item | None:
        """Return the item of an output without its meshes; None if there is none of this mesh."""
        item = read_head(self.path(target))
        return item if item and item.made_of == mesh_print["sha256"] else None

    def remove(self, targets: Iterable[str]) -> None:
        """Remove the items of some outputs, and the folder if nothing else is in it."""
        with suppress(OSError):
            for target in targets:
                self.path(target).unlink(missing_ok=True)
            self.folder.rmdir()
