"""Sphinx settings: pages in Markdown (MyST), the theme furo, the reference generated from the code."""

import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent / "src")]

project = "flytune"
author = "the flytune contributors"
release = metadata.version("flytune")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "commands",
    "task_file",
    "vehicle_page",
    "api",
]
exclude_patterns = ["_ext"]
html_theme = "furo"
html_title = "flytune"
html_static_path = ["_static"]
html_css_files = ["flytune.css"]
html_copy_source = False
html_show_sphinx = False

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # pages written by programs may begin below the first level

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_display_short_literal_types = True
python_maximum_signature_line_length = 80
default_role = "literal"
nitpicky = False
