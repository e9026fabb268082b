"""The site: ``sphinx-build -W docs site`` (extra ``docs``)."""

import re
from pathlib import Path

from super_sdf import __version__ as release
from super_sdf.cli.main import HEADINGS, cli
from super_sdf.options import GRID, MESH, VALUES, WORK

ROOT = Path(__file__).parents[1]
FROM_ROOT = {"index": "README.md", "develop/contributing": "CONTRIBUTING.md",
             "develop/security": "SECURITY.md"}  # fmt: skip

project, author = "super-sdf", "the authors of super-sdf"
extensions = ["myst_parser", "sphinx_click", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3  # headings are link targets, as on code hosts
autodoc_typehints = "none"  # numpydoc sections have the types
autodoc_member_order = "bysource"
html_theme, html_title = "furo", f"super-sdf {release}"
html_static_path, html_css_files = ["static"], ["site.css"]
html_show_copyright = smartquotes = False


def escape(app, ctx, lines):
    """Escape what is markup elsewhere in help texts, such as '**/*.npy' and FILE:NAME."""
    lines[:] = [re.sub("[*:]", r"\\\g<0>", line) for line in lines]


def helps(command):
    """Return the options of a command, with their helps."""
    return {(name, getattr(each, "help", "")) for each in command.params for name in each.opts}


def sort_options(app, ctx, lines):
    """Put options under the headings of the help; leave out those that upsample has, too."""
    others = helps(cli.get_command(ctx, "upsample")) if ctx.command.name != "upsample" else set()
    shared = {name for name, _ in helps(ctx.command) & others}
    rows = {heading: [] for heading in (GRID, VALUES, MESH, WORK, "Output")}
    for part in re.split(r"^(?=\.\. option::)", "\n".join(lines), flags=re.MULTILINE):
        names = re.findall(r"(?<= )-[a-z-]+", part.split("\n")[0])
        if names and names[0] not in shared:
            heading = HEADINGS.get(names[0].lstrip("-").replace("-", "_"), "Output")
            rows[heading].append(part.replace("FILE:", r"FILE\:"))  # no link
    texts = ["\n".join([f"**{heading}**\n", *parts]) for heading, parts in rows.items() if parts]
    lines[:] = "\n\n".join(texts).split("\n")


def put_from_root(app, docname, source):
    """Put a page of the root in the place of the link to that page; its links are from the root."""
    if docname not in FROM_ROOT:
        return
    name, up = FROM_ROOT[docname], "../" * docname.count("/")
    text = re.sub(r"\]\((?!https?:)", f"](../{up}", (ROOT / name).read_text())
    moved = {"docs/": "", "src/super_sdf/models/": "models/"}
    moved |= {path: f"{page}.md" for page, path in FROM_ROOT.items()}
    for path, page in moved.items():
        text = text.replace(f"](../{up}{path}", f"]({up}{page}")
    source[0] = source[0].replace(f"[{name}](../{up}{name})", text, 1)


def setup(app):
    """Have the functions above called."""
    app.connect("source-read", put_from_root)
    app.connect("sphinx-click-process-options", sort_options)
    for part in ("description", "epilog"):
        app.connect(f"sphinx-click-process-{part}", escape)
