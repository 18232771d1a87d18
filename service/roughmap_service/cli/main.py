"""The `roughmap` command: finds the subcommand, and turns errors into one line and an exit code.

A command is loaded when it is named, so that `roughmap --help` needs none of numba, zenoh or matplotlib. Exit
codes: 0 done; 1 it failed; 2 bad use, a bad setting or bad input; 130 interrupted.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

import click

COMMANDS = {
    "serve": "keep one map: scans and poses in, tiles out, everything logged",
    "demo": "the whole job on this machine: service, rover, planner, replay, pictures",
    "simulate": "a rover on known ground that publishes scans and poses",
    "replay": "integrate a log again and compare it with what was logged",
    "query": "ask a running service for a region: table, PNG, NPZ",
    "top": "watch a running service: rates, lag, rejections, robots, memory",
    "health": "does the service work? one line, exit 0 or 1",
    "doctor": "would it work here? configuration, machine, network, robots",
    "build": "make a map.db from recorded clouds, without a service",
    "config": "show, check or describe the configuration",
}
"""Name -> what `roughmap --help` says of it. The command is the function of that name in the module of that name."""


class _Lazy(click.Group):
    """A group whose commands are imported when they are asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"roughmap_service.cli.{cmd_name}")
        command: click.Command = getattr(module, cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(version("roughmap"), prog_name="roughmap", message="%(prog)s %(version)s")
def cli() -> None:
    """roughmap demo

    A rough-ground map from laser scans and poses, kept up to date point by point, logged so that every run can
    be replayed to the bit, and served to planners over Zenoh. The line above runs it all on this machine;
    `roughmap COMMAND --help` opens with a line that runs that command.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run the command line; returns the exit code, with at most one line about an error on stderr."""
    try:
        result = cli.main(list(arguments), prog_name="roughmap", standalone_mode=False)
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (click.Abort, KeyboardInterrupt):
        return complain("interrupted", 130)
    except _NO_ARGUMENTS as error:
        click.echo(error.format_message(), err=True)  # the help: more use than a line that says what is missing
        return error.exit_code
    except click.UsageError as error:
        where = f" (see: {error.ctx.command_path} --help)" if error.ctx is not None else ""
        return complain(error.format_message() + where, error.exit_code)
    except click.ClickException as error:
        return complain(error.format_message(), error.exit_code)
    except BrokenPipeError:
        # The reader of our output left, as `| head` does. What is still buffered must not be tried again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise  # a bug in roughmap: the traceback helps to find it
        return complain(_text(error), code)
    return result if isinstance(result, int) else 0


_NO_ARGUMENTS: type[click.UsageError] | tuple[()] = getattr(click.exceptions, "NoArgsIsHelpError", ())
"""What click raises, from 8.2 on, for a group without a command; before, it shows the help by itself."""


def _exit_code(error: Exception) -> int | None:
    """Return the exit code for an error; None for a bug in roughmap."""
    from roughmap_schemas.faults import ReportedError

    if isinstance(error, ReportedError):
        return error.exit_code
    zenoh_error = getattr(sys.modules.get("zenoh"), "ZError", OSError)  # only a command that uses zenoh imports it
    return 1 if isinstance(error, (OSError, zenoh_error)) else None


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error) or type(error).__name__


def complain(message: str, code: int) -> int:
    """Tell of an error in one line; returns the exit code."""
    from roughmap_service.host.log_lines import printable

    click.echo(f"roughmap: {printable(' '.join(message.split()))}", err=True)
    return code


if __name__ == "__main__":
    main()
