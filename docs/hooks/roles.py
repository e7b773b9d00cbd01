"""Docstrings name things by Sphinx's roles, :func:`plan`; on the site that is code, `plan`."""

import re

import griffe

ROLE = re.compile(r":(?:mod|class|func|meth|attr|data|exc):`~?([^`]+)`")


class Roles(griffe.Extension):
    """Drop the roles from every docstring."""

    def on_object(self, *, obj, **_):
        if obj.docstring:
            obj.docstring.value = ROLE.sub(r"`\1`", obj.docstring.value)
