"""Terminals that lack a character get a plain one, from every command and without an error."""

import io
import os
import re
import subprocess
import sys

import pytest

from slipcar.evaluation import terminal

COMMANDS = {
    "help": ["--help"],
    "help of a command": ["compare", "--help"],
    "plan": ["plan", "--starts", "2"],
    "compare": ["compare", "--episodes", "64", "--no-figures", "--folder", "results/compare"],
    "simulate": ["simulate", "--episodes", "2"],
    "a bad word": ["plan", "--scenario", "λ"],
}


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_speaks_plainly(name, encoding, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "slipcar.evaluation", *COMMANDS[name]],
        env=os.environ | {"PYTHONIOENCODING": encoding},
        cwd=tmp_path,
        capture_output=True,
        check=False,
    )
    out, errors = (text.decode(encoding) for text in (done.stdout, done.stderr))
    assert done.returncode == (2 if name == "a bad word" else 0), errors
    assert "Traceback" not in errors
    if name == "a bad word" and encoding == "ascii":
        assert "unknown scenario 'lambda'" in errors
    if name == "plan":
        assert re.search(r"tr Sigma|tr Sum|int ", out)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("∫ tr Σ dt ≤ 10⁻³", "int  tr Sum  dt <= 10^-^3"),
        ("┌─┐│", "+-+|"),
        ("é ½ x̂", "e 1/2 x"),
        ("日", "?"),
        ("plain", "plain"),
    ],
)
def test_characters_have_plain_twins(text, plain):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors=terminal.PLAIN)
    stream.write(text)
    stream.flush()
    assert stream.buffer.getvalue().decode("ascii") == plain


def test_terminals_that_speak_unicode_are_left_alone(monkeypatch):
    streams = {
        encoding: io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        for encoding in ("utf-8", "cp1252")
    }
    monkeypatch.setattr(sys, "stdout", streams["utf-8"])
    monkeypatch.setattr(sys, "stderr", streams["cp1252"])
    terminal.speak_plainly()
    assert streams["utf-8"].errors == "strict"
    assert streams["cp1252"].errors == terminal.PLAIN
