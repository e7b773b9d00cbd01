"""What a command prints stands on a page because it was run when the site was built.

A line `<!-- printed: slipcar plan --help -->` is replaced by the command and its output; with
`COMMAND` for the command, by a section for each that there is.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile

from mkdocs.exceptions import PluginError

from slipcar.evaluation.cli import COMMANDS

MARK = re.compile(r"^<!-- printed: (slipcar .*?) -->$", re.MULTILINE)
EVERY = re.compile(r"^<!-- printed: (slipcar) COMMAND (.*?) -->$", re.MULTILINE)
_DONE = {}


def on_page_markdown(markdown, **_):
    """Run what the marks of a page name."""
    markdown = EVERY.sub(
        lambda mark: "\n\n".join(
            f"## slipcar {name}\n\n<!-- printed: {mark[1]} {name} {mark[2]} -->"
            for name in COMMANDS
        ),
        markdown,
    )
    return MARK.sub(lambda mark: f"```text\n$ {mark[1]}\n{printed(mark[1])}\n```", markdown)


def printed(command):
    """The output of a `slipcar` command, 80 columns wide, from an empty folder."""
    if command not in _DONE:
        words = [sys.executable, "-m", "slipcar.evaluation", *shlex.split(command)[1:]]
        plain = {"COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb", "PYTHONIOENCODING": "utf-8"}
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                words, env=os.environ | plain, cwd=folder, capture_output=True, text=True
            )
        if done.returncode:
            raise PluginError(f"{command} ended with {done.returncode}:\n{done.stderr}")
        _DONE[command] = "\n".join(line.rstrip() for line in done.stdout.strip().splitlines())
    return _DONE[command]
