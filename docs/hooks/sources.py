"""Files of the repository that pages link to become pages, so that the site needs no host of code.

A link in `docs/planner.md` to `../planner/problem/protocol.py` leads to that file where the
repository is read, and to `source/planner/problem/protocol.py.md` on the site: Markdown as it is,
a folder as a list, everything else as a listing.
"""

import posixpath
import re
from pathlib import Path, PurePosixPath

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
#: An inline link or image of Markdown: what is before the target, the target, its anchor.
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(?=[)\s])")


def on_files(files, config):
    """Add a page for every file that a page links to, and for those that these link to."""
    pending = [file for file in files if file.src_uri.endswith(".md")]
    while pending:
        file = pending.pop()
        text = file.content_string
        for link in LINK.finditer(text):
            path = repository_path(file.src_uri, link[2])
            uri = path and site_uri(path)
            if uri and uri.startswith("source/") and not files.get_file_from_path(uri):
                page = File.generated(config, uri, content=contents(path))
                files.append(page)
                pending.append(page)
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links to files of the repository into links to pages of the site."""
    uri = page.file.src_uri

    def on_site(link):
        path = repository_path(uri, link[2])
        target = path and site_uri(path)
        if not target or not files.get_file_from_path(target):
            return link[0]
        return link[1] + posixpath.relpath(target, posixpath.dirname(uri)) + (link[3] or "")

    return LINK.sub(on_site, markdown)


def repository_path(uri, target):
    """The file or folder that a link on a page means, from the repository's root; None if none."""
    if uri.startswith("source/"):
        home = posixpath.dirname(uri.removeprefix("source/").removesuffix(".md"))
    else:
        home = posixpath.join("docs", posixpath.dirname(uri))
    path = posixpath.normpath(posixpath.join(home, target))
    outside = path.startswith("..") or posixpath.isabs(target)
    return None if outside or not (ROOT / path).exists() else path


def site_uri(path):
    """Where the site has a file of the repository."""
    return path.removeprefix("docs/") if path.startswith("docs/") else f"source/{path}.md"


def contents(path):
    """The page of a file or folder, in Markdown."""
    place = ROOT / path
    if place.is_dir():
        names = sorted(p.name for p in place.iterdir() if p.suffix in {".py", ".md", ".yml"})
        name = place.name
        return f"# `{path}`\n\n" + "".join(f"* [`{n}`]({name}/{n})\n" for n in names)
    text = place.read_text(encoding="utf-8")
    if place.suffix == ".md":
        return text
    language = {".py": "python", ".yml": "yaml", ".toml": "toml"}.get(place.suffix, "text")
    head = "---\nsearch:\n  exclude: true\n---\n\n"
    return f"{head}# `{PurePosixPath(path)}`\n\n`````{language}\n{text.rstrip()}\n`````\n"
