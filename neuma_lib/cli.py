"""The command ``neuma``, also ``python -m neuma_lib``."""

import argparse
import sys
from collections.abc import Sequence

from neuma_lib import __version__
from neuma_lib.commands import datasets, experiments, laws, projects
from neuma_lib.errors import InputError, NonFiniteError


def main(words: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        words: its arguments; None: those of the process.

    Returns:
        exit status: 0, or 1 after an error that the user can correct, which is printed.
    """
    options = _parser().parse_args(words)
    try:
        return options.run(options) or 0
    except (InputError, NonFiniteError) as error:
        print(f"ERROR: {error}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neuma",
        description="Learn the material of a deformable object from video. `neuma COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"neuma {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for room in (projects, experiments, laws, datasets):
        room.add_commands(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
