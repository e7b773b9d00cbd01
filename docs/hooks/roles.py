"""Docstrings name things by Sphinx's roles, :func:`plan`; on the site that is code, `plan`.

Their headings, `## Action space` as in Gymnasium, are one level below what they belong to.
"""

import re

import griffe

HEADING = re.compile(r"^## ", re.MULTILINE)
ROLE = re.compile(r":(?:mod|class|func|meth|attr|data|exc):`~?([^`]+)`")


class Roles(griffe.Extension):
    """Drop the roles and a level of headings from every docstring."""

    def on_object(self, *, obj, **_):
        if obj.docstring:
            text = ROLE.sub(r"`\1`", obj.docstring.value)
            obj.docstring.value = HEADING.sub("# ", text)
