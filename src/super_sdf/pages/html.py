"""One HTML page of facts, meshes, style and scripts; it can load nothing that is not its own.

Whatever comes from files is in blocks of JSON, which a browser does not take for markup, and is
shown as text. A content security policy names the hashes of the scripts and forbids all else.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from string import Template
from typing import Any

from .. import __version__
from ..certificate import coloured
from ..files.output import replacing

HOME = Path(__file__).parent
SCRIPTS = ("three.min.js", "viewer.js", "page.js")
GENERATOR = "super-sdf"
HEAD_BYTES = 4096  # of a page, in which its generator is looked for
MARKUP = {ord(c): f"\\u{ord(c):04x}" for c in "<>&"}  # of JSON in which a tag could be read


def make_page(
    facts: Mapping[str, Any], meshes: Mapping[str, Any] | None = None, *, beside: bool = False
) -> str:
    """Return a page.

    Parameters
    ----------
    facts : dict
        ``title``, ``lead`` (a sentence), ``alert`` (a sentence or ""), ``summary`` (rows of label
        and text), ``notes`` and ``files``, entries as ``entries`` makes them.
    meshes : dict, optional
        Packed meshes by the id of their entry, which are put into the page.
    beside : bool
        Whether it may load scripts from beside it, with the meshes that are not in it.
    """
    style = (HOME / "page.css").read_text("utf-8")
    scripts = [(HOME / name).read_text("utf-8") for name in SCRIPTS]
    said = {**facts, "version": __version__, "made": made_now(), "colours": residual_colours()}
    blocks = [json_block(f"meshes-{name}", packed) for name, packed in (meshes or {}).items()]
    return Template((HOME / "page.html").read_text("utf-8")).substitute(
        policy=policy(style, scripts, beside),
        generator=GENERATOR,
        style=style,
        facts=safe_json(said),
        meshes="\n".join(blocks),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def policy(style: str, scripts: list[str], beside: bool) -> str:
    """Return the content security policy: these scripts and this style, and nothing else."""
    own = " ".join(map(source_hash, scripts)) + (" 'self' file:" if beside else "")
    return (
        f"default-src 'none'; script-src {own}; style-src {source_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def source_hash(text: str) -> str:
    """Return the hash by which a policy names an inline script or style."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def safe_json(value: Any) -> str:
    """Return JSON in ASCII without the characters of markup, which are escaped."""
    return json.dumps(value, ensure_ascii=True, allow_nan=False).translate(MARKUP)


def json_block(name: str, value: Any) -> str:
    """Return an element that holds JSON; ``name`` is one of ours, never a file's."""
    return f'<script type="application/json" id="{name}">{safe_json(value)}</script>'


def made_now() -> str:
    """Return the local time."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")


def residual_colours() -> dict[str, Any]:
    """Return the scale of residual colours, which is that of ``check --out``."""
    names = {"touching": "TOUCHING", "pierced": "PIERCED", "apart": "NOT_TOUCHING"}
    found = {key: list(getattr(coloured, name)) for key, name in names.items()}
    return {**found, "unknown": list(coloured.UNKNOWN), "full": coloured.FULL}


def write_page(text: str, path: Path, *, force: bool = False) -> None:
    """Write a page, complete or not at all."""
    with replacing(path, force=force) as part:
        part.write_bytes(text.encode("utf-8"))


def is_page(path: Path) -> bool:
    """Return whether a file is a page that super-sdf has written."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return f'<meta name="generator" content="{GENERATOR}">'.encode() in head
