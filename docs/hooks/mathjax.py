"""MathJax is shipped with the site: one file, of the package that the extra `docs` installs."""

from importlib.metadata import files as files_of

from mkdocs.structure.files import File


def on_files(files, config):
    """Add MathJax's TeX input and SVG output, which needs no fonts."""
    (script,) = (f for f in files_of("django-static-mathjax") if f.match("es5/tex-svg.js"))
    content = script.locate().read_text(encoding="utf-8")
    files.append(File.generated(config, "assets/tex-svg.js", content=content))
    return files
