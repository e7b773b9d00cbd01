"""Look at the built site in a browser, from the file system: python docs/hooks/check.py site.

Every page, and every other HTML file that is named, is opened in Chromium and must

* have no violation of axe-core's rules, in light and dark,
* ask for nothing that is not a file of the site,
* raise no error, and typeset its mathematics.

Needs Chromium on the machine; axe-core comes with axe-playwright-python.
"""

import argparse
import os
import shutil
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import sync_playwright

#: Whether there are formulas, and none is typeset.
UNSET = "!!document.querySelector('.arithmatex') && !document.querySelector('mjx-container')"


def main() -> int:
    """Print what is wrong, page by page; the exit code is 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="+", type=Path, help="HTML files, and folders of them")
    parser.add_argument("--schemes", nargs="+", default=["light", "dark"])
    asked = parser.parse_args()
    pages = [page for place in asked.pages for page in html_in(place)]
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if chromium is None:
        print("no Chromium: install one, or name it in CHROMIUM", file=sys.stderr)
        return 2
    if not pages:
        print(f"no pages in {', '.join(map(str, asked.pages))}: build them first", file=sys.stderr)
        return 2
    wrong = 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for scheme in asked.schemes:
            context = browser.new_context(color_scheme=scheme)
            for path in pages:
                for line in findings(context, path.resolve()):
                    wrong += 1
                    print(f"{path} ({scheme}): {line}", flush=True)
        browser.close()
    print(f"{len(pages)} pages, {' and '.join(asked.schemes)}: {wrong} findings")
    return int(wrong > 0)


def html_in(place: Path) -> list[Path]:
    """A file itself, or all pages of a folder.

    Listings of source are left out, and the page for what is not found, which only a server shows.
    """
    if not place.is_dir():
        return [place]
    left_out = (".py.html", "404.html")
    return sorted(p for p in place.rglob("*.html") if not p.name.endswith(left_out))


def at_hand(url: str) -> bool:
    """Whether an address is within the page or a file that is there."""
    if url.startswith("file:"):
        return Path(unquote(urlsplit(url).path)).exists()
    return url.startswith(("data:", "blob:", "about:"))


def findings(context, path: Path) -> list[str]:
    """What is wrong with a page."""
    page = context.new_page()
    lines, asked, heard = [], [], []
    page.on("pageerror", lambda error: lines.append(f"error: {error}"))
    page.on("console", lambda said: said.type in ("error", "warning") and heard.append(said.text))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    page.evaluate("window.MathJax && MathJax.startup && MathJax.startup.promise")
    lines += [f"asks for {url}" for url in asked if not at_hand(url)]
    lines += [f"says {text}" for text in heard]
    if page.evaluate(UNSET):
        lines.append("its mathematics is not typeset")
    for violation in Axe().run(page).response["violations"]:
        nodes = [node["html"].split("\n")[0][:120] for node in violation["nodes"]]
        lines.append(f"{violation['id']} ({violation['impact']}), {len(nodes)}: {nodes[0]}")
    page.close()
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
