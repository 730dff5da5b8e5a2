"""The `gdpro` command."""

from __future__ import annotations

import signal
import sys
import traceback
from typing import Annotated

import typer
from typer.exceptions import TyperException

import gdpro_sim
from gdpro_sim.cli import compose, experiments, files, generation, mjcf, rollout, verify  # noqa: F401  (they declare their commands)
from gdpro_sim.cli.common import app
from gdpro_sim.errors import GdproError


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        print(gdpro_sim.__version__)
        raise typer.Exit


class _Terminated(BaseException):
    """SIGTERM: end like Ctrl-C, so that files are closed and workers stopped."""


def _terminate(*_: object) -> None:
    raise _Terminated


def main() -> None:
    """Entry point: one line per error; exits with 0, 1 (failed run), 2 (wrong request), 130 (Ctrl-C), 143."""
    debug = "--debug" in sys.argv
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(standalone_mode=False) or 0
        if code == 130:  # typer turns Ctrl-C into this exit code
            raise KeyboardInterrupt
        sys.exit(code)
    except TyperException as error:
        if not error.format_message():  # the help text was printed instead
            sys.exit(2)
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "gdpro"
        print(f"gdpro: {error.format_message()} (see `{command} --help`)", file=sys.stderr)
        sys.exit(2)
    except GdproError as error:
        if debug:
            traceback.print_exc()
        for line in str(error).splitlines():
            print(f"gdpro: {line}", file=sys.stderr)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        kept = ""
        if "simulate" in sys.argv or "animate" in sys.argv:
            kept = "; finished frames are kept, the same command continues"
        elif "rollout" in sys.argv:
            kept = "; finished rollouts are kept, the same command continues"
        elif "generate" in sys.argv and ("--run" in sys.argv or "--resume" in sys.argv):
            kept = "; the last checkpoint is kept, the same command continues"
        print(f"gdpro: interrupted{kept}", file=sys.stderr)
        sys.exit(130)
    except _Terminated:
        sys.exit(143)
    except MemoryError:
        print("gdpro: out of memory; lower --budget or the number of tetrahedra", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except Exception as error:
        if debug:
            traceback.print_exc()
        print(f"gdpro: {type(error).__name__}: {error} (run again with --debug for details)", file=sys.stderr)
        sys.exit(1)
