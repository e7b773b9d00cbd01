"""What is printed where the terminal cannot say it: `∫` in ASCII, `λ` in a code page of 1985.

Tables and certificates are full of mathematics. Python raises where the encoding of the standard
output lacks a character; here such a character becomes the nearest plain one. Terminals that speak
Unicode see no difference.
"""

from __future__ import annotations

import codecs
import sys
import unicodedata

#: Name of the error handler.
PLAIN = "slipcar.plain"
_TWINS = {
    **dict.fromkeys("‐‑‒–—―−─━═╌╴╶╸╺", "-"),
    **dict.fromkeys("│┃║╎", "|"),
    **dict.fromkeys("┌┐└┘├┤┬┴┼╭╮╯╰╔╗╚╝╠╣╦╩╬┏┓┗┛┡┩╇┳┻╋", "+"),
    **dict.fromkeys("█▉▊▋▌▍▎▏▁▂▃▄▅▆▇■", "#"),
    **dict.fromkeys("‘’ʼ′", "'"),
    **dict.fromkeys("“”″", '"'),
    **dict.fromkeys("·•∙⋅×✕", "*"),
    **dict.fromkeys("✓✔", "x"),
    **{"≤": "<=", "≥": ">=", "≠": "!=", "≈": "~", "±": "+-", "→": "->", "←": "<-", "…": "..."},
    **{"∫": "int ", "∂": "d", "√": "sqrt ", "∞": "inf", "Σ": "Sum ", "∈": "in", "‖": "||"},
    **{"°": "deg", "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "epsilon"},
    **{"θ": "theta", "λ": "lambda", "μ": "mu", "µ": "mu", "ν": "nu", "ξ": "xi", "π": "pi"},
    **{"ρ": "rho", "σ": "sigma", "τ": "tau", "φ": "phi", "ω": "omega", "Δ": "Delta", "Φ": "Phi"},
    **{"𝔭": "p", "ℓ": "l", "²": "^2", "³": "^3", "⁴": "^4", "⁻": "^-", "ᵀ": "^T"},
}


def plain(character: str) -> str:
    """A character in ASCII: its twin, its letter without accents, or a question mark."""
    if twin := _TWINS.get(character):
        return twin
    if unicodedata.combining(character):
        return ""
    letters = unicodedata.normalize("NFKD", character).replace("\u2044", "/")  # of ½
    return letters.encode("ascii", "ignore").decode() or "?"


def _replaced(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(plain(character) for character in lacking), error.end


codecs.register_error(PLAIN, _replaced)


def speak_plainly() -> None:
    """From now on, print what a stream's encoding lacks in plain characters, and raise nothing."""
    for stream in (sys.stdout, sys.stderr):
        encoding = str(getattr(stream, "encoding", None) or "")
        if hasattr(stream, "reconfigure") and not encoding.lower().startswith("utf"):
            stream.reconfigure(errors=PLAIN)
