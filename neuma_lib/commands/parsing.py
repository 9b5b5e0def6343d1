"""Parts of the parser that commands share."""

import argparse
from collections.abc import Callable
from typing import Any

Argument = tuple[tuple[str, ...], dict[str, Any]]
CONFIGFILES = "settings on top of config/config.yaml, as for snakemake"


def argument(*names: str, **options: Any) -> Argument:
    """An argument of `add_command`, with the parameters of `argparse.ArgumentParser.add_argument`."""
    return names, options


CORES = argument("--cores", type=int, default=2, help="CPU cores to use (default %(default)s)")
CONFIGFILE = argument("--configfile", nargs="+", default=[], metavar="FILE", help=CONFIGFILES)


def add_command(
    commands: Any,
    run: Callable[[argparse.Namespace], Any],
    summary: str,
    description: str,
    *arguments: Argument,
) -> None:
    """Add a command. The summary begins with its name and a colon."""
    name, _, text = summary.partition(": ")
    parser = commands.add_parser(name, help=text, description=description)
    parser.set_defaults(run=run)
    for names, options in arguments:
        parser.add_argument(*names, **options)


def add_group(commands: Any, name: str, summary: str) -> Any:
    """Add a command that has subcommands, and return what they are added to."""
    parser = commands.add_parser(name, help=summary, description=f"{summary.capitalize()}.")
    return parser.add_subparsers(required=True, metavar="COMMAND")
