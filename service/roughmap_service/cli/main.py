"""The `roughmap` command: finds the subcommand, and turns errors into one line and an exit code.

Only the named subcommand is imported, so that `roughmap --help` loads none of numba, zenoh and matplotlib. Exit codes:
0 success; 1 failure; 2 bad usage, setting or input; 3 a replay that can't be compared; 130 interrupted.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

import click

COMMANDS = {
    "demo": "run service, rover, planner and replay on this machine; draw the map",
    "serve": "run the mapping service",
    "simulate": "publish the scans and poses of a simulated rover, or recorded scans",
    "ros2": "take part in ROS 2 for a running service",
    "query": "get a region of a running service's map as a table, PNG or NPZ",
    "top": "watch a running service in the terminal",
    "health": "check that the service works; exit code 0 or 1",
    "doctor": "check configuration, machine, network and robots",
    "replay": "integrate a log again and compare with the logged results",
    "build": "make a map.db from recorded clouds, without a service",
    "export": "write the map for other tools: GIS, point clouds, Nav2, RViz",
    "config": "show, check or describe the configuration",
}
"""The commands in the order of `roughmap --help`, each with its summary. A command is a function in a module, both of
that name."""


class _Lazy(click.Group):
    """A group that imports a command when it is needed."""

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

    Map rough ground from laser scans and robot poses. The map is updated point by point and served over Zenoh;
    every run is logged and can be replayed to the same bits. The line above runs all of it on this machine, in
    about a minute.

    The help of each command begins with a line that you can run: `roughmap COMMAND --help`. For a service of your
    own, begin with `roughmap config example`, then `serve`; `simulate`, `query`, `top`, `health` and `doctor` work
    beside it in a second terminal.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run the command line and return the exit code; an error is one line on stderr."""
    try:
        result = cli.main(list(arguments), prog_name="roughmap", standalone_mode=False)
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (click.Abort, KeyboardInterrupt):
        return complain("interrupted", 130)
    except _NO_ARGUMENTS as error:
        click.echo(error.format_message(), err=True)  # the help, as click has it
        return error.exit_code
    except click.UsageError as error:
        where = f" (see: {error.ctx.command_path} --help)" if error.ctx is not None else ""
        return complain(error.format_message() + where, error.exit_code)
    except click.ClickException as error:
        return complain(error.format_message(), error.exit_code)
    except BrokenPipeError:
        # The reader of stdout has gone, as with `| head`. Without this, Python would flush and fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise  # a bug in roughmap: the traceback helps to find it
        return complain(_text(error), code)
    return result if isinstance(result, int) else 0


_NO_ARGUMENTS: type[click.UsageError] | tuple[()] = getattr(click.exceptions, "NoArgsIsHelpError", ())
"""Raised by click 8.2 and later for a group without a command; earlier versions print the help themselves."""


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
    """Print an error as one line on stderr; return the exit code."""
    from roughmap_service.host.log_lines import printable

    click.echo(f"roughmap: {printable(' '.join(message.split()))}", err=True)
    return code


if __name__ == "__main__":
    main()
