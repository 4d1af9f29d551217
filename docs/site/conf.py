"""Settings of Sphinx for the site: pages in Markdown, warnings as errors (make site)."""

from palpate import __version__

project = "Palpate"
release = __version__
extensions = ["myst_parser"]
root_doc = "index"
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4
suppress_warnings = ["misc.highlighting_failure"]  # URScript, KRL and RAPID have no lexer
smartquotes = False  # quotes belong to settings and commands
html_theme = "furo"
html_title = "Palpate"
html_show_copyright = False
html_copy_source = False
html_show_sphinx = False
