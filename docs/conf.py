"""Sphinx: ``make docs`` builds the pages of this folder, the tutorial and the API reference."""

from importlib.metadata import version as installed

project = "torchrl-safe"
version = release = installed("torchrl-safe")
html_theme = "furo"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_inherit_docstrings = False  # TorchRL and Gymnasium document their own.
autodoc_typehints = "none"  # The docstrings have them.
myst_heading_anchors = 3
napoleon_use_ivar = True
# Links to files of the repository, which are no pages.
suppress_warnings = ["myst.xref_missing"]
# `make test` runs the tutorial.
sphinx_gallery_conf = {
    "examples_dirs": "../tutorials",
    "gallery_dirs": "tutorials",
    "plot_gallery": False,
}
exclude_patterns = ["_build"]
