"""The site: ``sphinx-build -W docs site`` (extra ``docs``)."""

import re

from super_sdf import __version__ as release

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


def setup(app):
    """Have ``escape`` called for the text of each command."""
    for part in ("description", "epilog"):
        app.connect(f"sphinx-click-process-{part}", escape)
