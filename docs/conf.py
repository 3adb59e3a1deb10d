"""Configuration of the documentation site; `make docs` builds it. The build needs no network."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import click
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import skindb
from skindb.cli import cli

HERE = Path(__file__).parent
ROOT = HERE.parent

project = "skindb"
author = "The skindb developers"
copyright = author  # noqa: A001  name required by Sphinx
version = release = skindb.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_design",
    "myst_nb",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
templates_path = ["_templates"]
default_role = "code"  # docstrings write names in single backticks

autosummary_generate = True
autosummary_imported_members = True
autosummary_ignore_module_all = False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # .ci/run_notebooks.py runs them and stores their outputs
nb_merge_streams = True

html_math_renderer = "mathml"  # browsers draw it without scripts and without a network
html_theme = "pydata_sphinx_theme"
html_title = f"skindb {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/logo.svg"
# no subpages
html_sidebars = {
    page: [] for page in ("index", "getting_started", "tutorial", "contributing")
}
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {
        "text": "skindb",
        "image_light": "_static/logo.svg",
        "image_dark": "_static/logo.svg",
    },
    "navigation_with_keys": False,
    "show_prev_next": True,
    "show_nav_level": 1,
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


def _copy_notebooks() -> None:
    """Copy the executed notebooks to the folder that Sphinx reads, or the notebooks
    without output if not executed.
    """
    target = HERE / "notebooks"
    target.mkdir(exist_ok=True)
    executed = HERE / "_build" / "notebooks"
    for source in sorted((ROOT / "notebooks").glob("*.ipynb")):
        run = executed / source.name
        fresh = run.is_file() and run.stat().st_mtime >= source.stat().st_mtime
        shutil.copyfile(run if fresh else source, target / source.name)


def _help_of(command: click.Command, name: str) -> str:
    """Help of a command as printed by the command line, with lines that fit on the page."""
    parent = click.Context(
        cli,
        info_name="skindb",
        max_content_width=82,
        terminal_width=82,
        **cli.context_settings,
    )
    return command.get_help(click.Context(command, parent=parent, info_name=name))


def _write_commands() -> None:
    """Write the page of all commands from their help texts."""
    parts = [
        "# Commands\n",
        (
            "This page is generated from the help texts of the commands. `skindb "
            "COMMAND --help` prints the same text.\n"
        ),
    ]
    for name, command in cli.commands.items():
        parts.append(f"## skindb {name}\n\n```text\n{_help_of(command, name)}\n```\n")
    page = HERE / "reference" / "commands.md"
    page.parent.mkdir(exist_ok=True)
    text = "\n".join(parts)
    if not page.is_file() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


def _inline(page: HTML5Translator, node: nodes.math) -> None:
    page.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> None:
    page.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def _copy_viewer(app: Sphinx) -> None:
    """Copy the viewer of `make demo`, if there is one, which the first page then shows."""
    viewer = ROOT / "demo" / "viewer.html"
    if viewer.is_file():
        Path(app.outdir).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(viewer, Path(app.outdir) / viewer.name)
        app.tags.add("viewer")


def _prepare(app: Sphinx) -> None:
    _copy_viewer(app)
    _copy_notebooks()
    _write_commands()


def _link_notebooks(_: Sphinx, page: str, source: list[str]) -> None:  # noqa: ARG001
    """Links to notebooks lead to the copies, which are one folder below the originals."""
    source[0] = re.sub(r"\]\(\.\./((?:\.\./)*notebooks/)", r"](\1", source[0])


def setup(app: Sphinx) -> None:
    """Copy and generate pages before Sphinx looks for sources."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    # before autosummary reads the sources
    app.connect("builder-inited", _prepare, priority=100)
    app.connect("source-read", _link_notebooks)
