"""Sphinx: ``make docs`` builds the pages of this folder, the tutorials and the API reference."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

from sphinx_gallery.sorting import ExplicitOrder

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "torchrl-safe"
copyright = "2026, the torchrl-safe authors"
version = release = installed("torchrl-safe")
html_theme = "furo"
html_title = "torchrl-safe"
pygments_dark_style = "github-dark"  # Furo's own underlines modules.
html_static_path = ["_static"]
html_css_files = ["site.css"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    # In _ext.
    "autodoc_fixes",
    "links",
    "mathml",
    "names",
    "tables",
    "tutorials",
]
autosummary_generate = False  # The pages of reference/ are written by hand.
autodoc_inherit_docstrings = False  # TorchRL and Gymnasium document their own.
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "description"  # Where the docstring has none.
autodoc_typehints_description_target = "documented_params"
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
napoleon_use_ivar = True
napoleon_attr_annotations = False  # Descriptions have shapes and units; these would be long.
# The order in which they are shown; those that it does not name come before the last two.
TUTORIALS = [
    "first_policy.py",
    "own_loop.py",
    "several_limits.py",
    "own_arm.py",
    "own_task.py",
    "any_environment.py",
    "off_policy.py",
    "own_loss.py",
    "*",
    "deploy.py",
    "safe_while_it_learns.py",
]
# Each runs in one of two processes, unless it has not changed since the last build; one that fails
# fails the build.
sphinx_gallery_conf = {
    "examples_dirs": "../tutorials",
    "gallery_dirs": "tutorials",
    "filename_pattern": r"\.py$",
    "within_subsection_order": ExplicitOrder(TUTORIALS),
    "parallel": 2,
    "remove_config_comments": True,
    "show_memory": False,
    "download_all_examples": False,
    "write_computation_times": False,  # Their page loads scripts from elsewhere.
}
exclude_patterns = ["_build", "_ext", "**sg_execution_times.rst"]
