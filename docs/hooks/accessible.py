"""What the theme and Markdown leave for readers to stumble over, those of a screen reader first.

The rest is in assets/site.css (contrast, underlined links) and assets/accessible.js (what the theme
builds in the browser); `make docs-check` holds all of it against axe-core's rules.
"""

import re

#: `| | |` over a table without headings makes headings without words.
EMPTY_HEADING = re.compile(r"<th((?: style=\"[^\"]*\")?)>\s*</th>")
NO_HEADINGS = re.compile(r"<thead>\s*<tr>\s*(?:<td[^>]*></td>\s*)+</tr>\s*</thead>\s*")
#: A number and its error, and an interval: they stay on a line.
WITH_ERROR = re.compile(r"(?<=\d) (±) (?=\d)")
INTERVAL = re.compile(r"(\[[-+−\d.%]+,) (?=[-+−\d.%]+\])")
DIALOG = '<div class="md-search" data-md-component="search" role="dialog"'


def on_page_content(html, **_):
    """Make cells of headings that say nothing; keep what belongs together on a line."""
    html = NO_HEADINGS.sub("", EMPTY_HEADING.sub(r"<td\1></td>", html))
    return INTERVAL.sub(r"\1&nbsp;", WITH_ERROR.sub(r"&nbsp;\1&nbsp;", html))


def on_post_page(output, **_):
    """Name the search dialog."""
    return output.replace(DIALOG, f'{DIALOG} aria-label="Search"')
