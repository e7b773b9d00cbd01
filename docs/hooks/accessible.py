"""What the theme and Markdown leave for a screen reader to stumble over.

The rest is in assets/site.css (contrast, underlined links) and assets/accessible.js (what the theme
builds in the browser); `make docs-check` holds all of it against axe-core's rules.
"""

import re

#: `| | |` over a table without headings makes headings without words.
EMPTY_HEADING = re.compile(r"<th((?: style=\"[^\"]*\")?)>\s*</th>")
DIALOG = '<div class="md-search" data-md-component="search" role="dialog"'


def on_page_content(html, **_):
    """Make cells of headings that say nothing."""
    return EMPTY_HEADING.sub(r"<td\1></td>", html)


def on_post_page(output, **_):
    """Name the search dialog."""
    return output.replace(DIALOG, f'{DIALOG} aria-label="Search"')
