"""Sphinx: the pages of docs/ as a site, in the Markdown that a repository's viewer shows too."""

import re

project = "magshell_fenicsx"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx-mathjax-offline"]
html_theme = "furo"
html_title = "magshell_fenicsx"
html_show_copyright = False
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["site"]
nb_custom_formats = {
    ".py": ["jupytext.reads", {"fmt": "py:percent"}]
}  # cases/notebooks, which docs/notebooks is
nb_execution_mode = "force"
nb_execution_timeout = 300  # s for a cell
nb_execution_raise_on_error = True
nb_merge_streams = True
myst_enable_extensions = ["dollarmath", "colon_fence", "html_image"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "description"
napoleon_use_ivar = True

# pages outside docs/ that the site contains too
OUTSIDE = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "meshes/README.md": "meshes.md",
}


def _as_myst(app, name, source):
    """Formulas and links of the repository's viewer in those of MyST."""
    text = re.sub(r"\$`([^`]*)`\$", r"$\1$", source[0])
    text = re.sub(r"^```math$", "```{math}", text, flags=re.MULTILINE)
    up = "../" * str(name).count("/")
    for file, page in OUTSIDE.items():
        text = re.sub(rf"\]\((\.\./)+{file}", f"]({up}{page}", text)
    source[0] = re.sub(r"\[([^]]*)\]\((\.\./)+cases/[^)]*\)", r"\1", text)  # not on the site


def _included(app, relative, parent, content):
    """The same for an included page, whose links begin elsewhere."""
    for file, page in OUTSIDE.items():
        content[0] = content[0].replace(f"]({file}", f"]({page}")
    _as_myst(app, parent, content)


def _escaped(app, what, name, obj, options, lines):
    """A bar is a magnitude in our docstrings, a star a product or a list of arguments."""
    lines[:] = [
        line if ">>>" in line else re.sub(r"([|*])(?=\w)|(?<=\w)\|", r"\\\g<0>", line)
        for line in lines
    ]


def setup(app):
    app.connect("source-read", _as_myst)
    app.connect("include-read", _included)
    app.connect("autodoc-process-docstring", _escaped)
