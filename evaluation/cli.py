"""The command line, `slipcar COMMAND`: each command a thin call of a function.

Bad values end in one line on the standard error and exit code 2; a plan that did not converge
or a row that failed in exit code 1; an interruption in 130.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from collections.abc import Callable, Sequence

from slipcar.evaluation.terminal import speak_plainly

#: Command -> what `slipcar --help` says of it. A command is a function in a module of its name;
#: it is imported when asked for, because help should not take a second.
COMMANDS = {
    "compare": "tables and figures: planners and policies, in suites of worlds",
    "dataset": "write episodes of any controller as a Minari dataset",
    "export": "a plan as C or JSON, a policy as ONNX or TorchScript",
    "frontier": "what safety costs: effort against collision rate",
    "live": "a page: drag obstacles, start and goal; plan, noise and risk follow",
    "plan": "plan one scenario: iterations, certificate, figures",
    "report": "one page of all results: tables, figures, animations",
    "reproduce": "the paper's claims, one by one, by numbers",
    "simulate": "drive a few episodes; show, draw or film them",
    "train": "train a policy: PPO and others, on a scenario or a family",
}
_DESCRIPTION = """Stochastic SCP, a slipping car, and an honest comparison with PPO.

    slipcar compare                      the paper's scenario: all methods, figures
    slipcar compare --suite random       100 worlds that nobody was trained or tuned on
    slipcar reproduce                    the paper's claims and what we get
    slipcar report results               one page of it all
    slipcar frontier                     the price of safety: three curves, PPO, the paper
    slipcar plan --figures figures       one plan, what it proves, figures
    slipcar COMMAND --help               every option of a command
    slipcar --version                    which slipcar this is

Every command knows --quiet (only what went wrong) and --json (numbers alone)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; None takes the process's.

    Returns:
        The exit code.
    """
    import tyro

    speak_plainly()
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        if arguments[:1] == ["--version"]:
            print(f"slipcar {importlib.metadata.version('slipcar')}")
            return 0
        if arguments and arguments[0] in COMMANDS:
            command = _command(arguments[0])
            prog = f"slipcar {arguments[0]}"
            return int(tyro.cli(command, prog=prog, args=arguments[1:]) or 0)
        # Help, or nothing that is a command: tyro says which there are.
        summaries = {name: _summary(text) for name, text in COMMANDS.items()}
        tyro.extras.subcommand_cli_from_dict(
            summaries, prog="slipcar", description=_DESCRIPTION, args=arguments
        )
    except SystemExit as stop:  # tyro has printed help (0) or what is wrong (2)
        if stop.code is None or isinstance(stop.code, int):
            return int(stop.code or 0)
        print(f"slipcar {arguments[0]}: error: {stop.code}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(f"slipcar: interrupted{f': {stop}' if str(stop) else ''}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read the output has enough of it; files are written before
        # Python would complain once more when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, ImportError) as error:
        print(f"slipcar {arguments[0]}: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return 0


def _command(name: str) -> Callable[..., int]:
    return getattr(importlib.import_module(f"slipcar.evaluation.commands.{name}"), name)


def _summary(text: str) -> Callable[[], None]:
    def summary() -> None:
        pass

    summary.__doc__ = text
    return summary


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    raise SystemExit(main())
