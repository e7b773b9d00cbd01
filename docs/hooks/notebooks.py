"""Notebooks are executed when the site is built, and shown as pages with what they printed.

The repository keeps them without outputs. The executed notebook lies beside its page, to download.
`SLIPCAR_DOCS_NOTEBOOKS=0` shows them unexecuted, for a look at the rest.
"""

import base64
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from mkdocs.structure.files import File
from nbclient import NotebookClient

#: What a terminal would turn into colours.
ESCAPES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
#: How pandas opens a table, dressed for another house.
PANDAS = re.compile(r"(?:<style scoped>.*?</style>\s*)?<table[^>]*>", re.DOTALL)
LINK = re.compile(r"(\]\([^)\s:]+)\.ipynb(?=[)#])")
#: Executed notebooks by source, for `mkdocs serve`, which builds again and again.
_DONE = {}


def on_files(files, config):
    """Put a page in the place of each notebook, pictures and the executed notebook beside it."""
    sources = [file for file in files if file.src_uri.endswith(".ipynb")]
    with ThreadPoolExecutor(2) as pool:
        executed = list(pool.map(lambda file: run(Path(file.abs_src_path)), sources))
    for file, notebook in zip(sources, executed, strict=True):
        files.remove(file)
        name = file.src_uri.removesuffix(".ipynb")
        text, pictures = as_markdown(notebook, Path(name).name)
        beside = {f"{name}.md": text, f"{name}.ipynb": nbformat.writes(notebook)}
        beside |= {f"{Path(name).parent.as_posix()}/{key}": data for key, data in pictures.items()}
        for uri, content in beside.items():
            files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown, **_):
    """Links to notebooks, as the repository has them, lead to their pages."""
    return LINK.sub(r"\1.md", markdown)


def run(path):
    """A notebook with its outputs. An error in it ends the build."""
    text = path.read_text(encoding="utf-8")
    if text not in _DONE:
        notebook = nbformat.reads(text, as_version=4)
        if os.environ.get("SLIPCAR_DOCS_NOTEBOOKS") != "0":
            NotebookClient(
                notebook, timeout=120, kernel_name="python3", extra_arguments=["--log-level=ERROR"]
            ).execute()
        _DONE[text] = notebook
    return _DONE[text]


def merged(outputs):
    """What was printed by turns, in one piece."""
    pieces = []
    for output in outputs:
        if pieces and "text" in output and "text" in pieces[-1]:
            pieces[-1] = {"text": pieces[-1]["text"] + output["text"]}
        else:
            pieces.append(output)
    return pieces


def as_markdown(notebook, name):
    """Markdown of a notebook, and its pictures by file name."""
    parts, pictures = [], {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in merged(cell.get("outputs", [])):
            data = output.get("data", {})
            if "image/png" in data:
                key = f"{name}-{len(pictures)}.png"
                pictures[key] = base64.b64decode(data["image/png"])
                alt = cell.metadata.get("alt", "What this cell draws")
                parts.append(f"![{alt}]({key})")
            elif "text/html" in data:
                html = PANDAS.sub("<table>", data["text/html"])
                parts.append(f'<div class="output" markdown="0">\n{html}\n</div>')
            elif text := output.get("text", data.get("text/plain", "")):
                parts.append(f"````text\n{ESCAPES.sub('', text).rstrip()}\n````")
    download = f'<a href="{name}.ipynb" download>This page as a notebook</a>'
    title, *rest = parts
    return "\n\n".join([title, download, *rest]) + "\n", pictures
