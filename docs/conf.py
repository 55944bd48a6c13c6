"""Settings of Sphinx: `make docs` builds the pages into docs/_build/html."""

from tk import __version__

project = "tk"
author = "the tk-mocap contributors"
copyright = f"2026, {author}"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "README.md"]  # index.rst includes README.md, which GitHub shows
html_theme = "furo"
html_title = f"tk {__version__}"

myst_heading_anchors = 3
autodoc_typehints = "none"  # docstrings give shapes and units
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_use_rtype = False
# Attributes with comma-separated names make a list of their own
napoleon_use_ivar = True
