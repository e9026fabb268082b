"""Write the measured figures into README, the documents and the model cards.

    python -m lab documents            # rewrites what stands between the markers
    python -m lab documents --check    # exit code 1 if a document differs

A table stands between ``<!-- figures: NAME.TABLE -->`` and ``<!-- /figures -->``, each on a line; a
number in a sentence between ``<!-- figures: NAME.COLUMN WORDS -->`` and ``<!-- /figures -->``.
"""

from __future__ import annotations

import re
from pathlib import Path

from super_sdf.errors import FileError

from . import parser_of
from .figures import FOLDER
from .quoted import UNKNOWN, shown

ROOT = Path(__file__).parents[1]
PLACES = ("README.md", "docs/**/*.md", "src/super_sdf/models/*.md")
MARKED = re.compile(r"(<!-- figures: ([^>]+?) -->)(.*?)(<!-- /figures -->)", re.DOTALL)


def documents() -> list[Path]:
    """Return the documents that show figures."""
    return sorted(path for place in PLACES for path in ROOT.glob(place))


def rendered(text: str, folder: Path = FOLDER) -> str:
    """Return a document with the figures as they were measured; others stay as they stand."""
    if len(MARKED.findall(text)) != len(re.findall(r"<!-- figures: ", text)):
        raise FileError("a marker of figures is not ended by <!-- /figures -->")

    def replace(match: re.Match[str]) -> str:
        found = shown(match[2].strip(), folder)
        if found == UNKNOWN and match[3].strip():
            return match[0]
        is_block = "\n" in match[3] or "\n" in found
        return match[1] + (f"\n\n{found}\n\n" if is_block else found) + match[4]

    return MARKED.sub(replace, text)


def main() -> int:
    """Rewrite the documents, or compare them."""
    parser = parser_of(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--figures", type=Path, default=FOLDER, help="folder of the JSON files")
    words = parser.parse_args()
    differ = 0
    for path in documents():
        before = path.read_text(encoding="utf-8")
        try:
            after = rendered(before, words.figures)
        except FileError as error:
            raise FileError(f"{path.relative_to(ROOT)}: {error}") from error
        if after != before:
            differ += 1
            print(path.relative_to(ROOT))
            if not words.check:
                path.write_text(after, encoding="utf-8")
    return int(words.check and differ > 0)
