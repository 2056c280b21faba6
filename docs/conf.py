"""How Sphinx builds the site: `make docs`."""

import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

import torchelev  # noqa: E402

project = "torchelev"
author = "the torchelev authors"
project_copyright = author
release = version = torchelev.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    *(f"docs.extensions.{name}" for name in ("c_header", "docstrings", "fields", "filters", "help_texts", "mathml")),
]
exclude_patterns = ["_build", "extensions", "pictures/README.md"]
nitpicky = True
# Without a page: other libraries' names, and types of this one's that only its own functions pass on.
_INTERNAL = (
    r"torchelev\.(observations\.patterns|planes\.local_planes|traversability\.weight_file|stages"
    r"|filters\.registry|io\.files\.arrays|io\.folders\.clock|site\.service\.(server\.answers|questions|wire\.transport))\."
)
nitpick_ignore_regex = [("py:obj", ".*"), ("py:.*", r"^(?!torchelev\.).*"), ("py:class", rf"{_INTERNAL}.*")]

# Pages
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
myst_links_external_new_tab = True
nb_execution_mode = "off"
math_renderer = html_math_renderer = "mathml"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# Reference
default_role = "py:obj"  # `name` links to what it names, where the site has it
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 60
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True

# Looks
html_theme = "furo"
html_title = f"torchelev {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
pygments_style, pygments_dark_style = "friendly", "github-dark"
html_theme_options = {"navigation_with_keys": True}


def _copy_notebooks() -> None:
    """Copy the notebooks beside the pages, as Sphinx reads nothing outside of its folder."""
    folder = DOCS / "notebooks"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(DOCS.parent / "notebooks", folder, ignore=shutil.ignore_patterns(".ipynb_checkpoints"))


_copy_notebooks()
