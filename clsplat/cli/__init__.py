"""Run the command line.  An error prints one line and sets the exit code."""

import difflib
import os
import sys
import traceback
from typing import Any

import typer

from clsplat.cli import models, runs, tools  # noqa: F401  register their commands
from clsplat.cli.app import WrappedError, app
from clsplat.core import signals, terminal
from clsplat.core.errors import Interrupted, as_clsplat_error, one_line
from clsplat.core.signals import stop_at_once, stopping_on_signals

COMPLETION = "_CLSPLAT_COMPLETE"  # environment variable that a shell sets to request completions
DEBUG, PLUGIN = "--debug", "--plugin"  # options that may come before or after the command
# options whose value is optional: the default, and a test of whether the next argument is a value
OPTIONAL_VALUES = {"--live": ("0", str.isdecimal), "--depth": ("mean", ("mean", "median").__contains__)}


def main(*prefix: str) -> None:
    """Run the command line.  An error prints one line, and with --debug also its traceback.

    prefix: arguments to insert before those of the process.
    """
    signals.install()
    arguments = _move_options_first(_expand_optional(_expand_set([*prefix, *sys.argv[1:]])))
    try:
        with stopping_on_signals(stop_at_once):
            exit_code = app(arguments, prog_name="clsplat", standalone_mode=False)
            if exit_code:  # 130: typer returns it for a KeyboardInterrupt before the command starts
                raise KeyboardInterrupt
            if exit_code is not None:  # of --help and --version; commands return None
                signals.check_output()
            code = 0
    except BaseException as error:
        if isinstance(error, SystemExit) and COMPLETION in os.environ:
            raise
        code = _report(error, DEBUG in arguments[:1])
    sys.exit(code)


def _report(error: BaseException, is_debugging: bool) -> int:
    """Print a line for an error or for an interruption by the user, and return the exit code."""
    if isinstance(error, WrappedError | typer.Abort):
        error = error.__cause__ or error
    if isinstance(error, KeyboardInterrupt):  # outside a run; the message of a run says how to continue
        error = Interrupted("stopped")
    if is_debugging:
        traceback.print_exception(error)
    if hasattr(error, "format_message"):  # from typer
        message, code = _usage(error), 2
    else:
        failure = as_clsplat_error(error)
        message, code = one_line(failure) or type(failure).__name__, failure.exit_code
    terminal.STDERR_CONSOLE.print(message if code == Interrupted.exit_code else f"error: {message}", markup=False)
    return code


def _usage(error: Any) -> str:
    """Return a line of text with the error in the command line and the command that shows help."""
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "clsplat"
    if type(error).__name__ == "NoArgsIsHelpError":
        print(error.format_message(), end="")
        return f"{command}: expected a command"
    if option := getattr(error, "option_name", None) if hasattr(error, "possibilities") else None:
        parameters = context.command.get_params(context) if context else []
        names = [name for parameter in parameters for name in parameter.opts]
        matches = difflib.get_close_matches(option, [name for name in names if name.startswith("-")], n=1, cutoff=0.5)
        hint = f"did you mean {matches[0]}?" if matches else f"see `{command} --help`"
        return f"{command}: no option {option}; {hint}"
    message = " ".join(error.format_message().split()).rstrip(".")
    return f"{command}: {message[:1].lower()}{message[1:]}; see `{command} --help`"


def _expand_set(arguments: list[str]) -> list[str]:
    """Expand `--set a=1 b=2` to `--set a=1 --set b=2`."""
    result: list[str] = []
    for argument in arguments:
        is_setting = len(result) >= 2 and result[-2] == "--set"
        result += ["--set", argument] if is_setting and "=" in argument and argument[0] != "-" else [argument]
    return result


def _expand_optional(arguments: list[str]) -> list[str]:
    """Add the default value to options that were given without their optional value: `--live` becomes `--live=0`."""
    expanded = []
    for argument, next_argument in zip(arguments, [*arguments, ""][1:], strict=True):
        default, is_value = OPTIONAL_VALUES.get(argument, ("", bool))
        expanded.append(f"{argument}={default}" if default and not is_value(next_argument) else argument)
    return expanded


def _move_options_first(arguments: list[str]) -> list[str]:
    """Move `--debug` and `--plugin FILE` before the command."""
    others = [argument for argument in arguments if argument != DEBUG]
    first = [DEBUG] if len(others) < len(arguments) else []
    remaining_arguments: list[str] = []
    while others:
        size = 1 if others[0].startswith(f"{PLUGIN}=") else 2 if others[0] == PLUGIN and len(others) > 1 else 0
        first += others[:size]
        remaining_arguments += others[size : size or 1]
        del others[: size or 1]
    return first + remaining_arguments
