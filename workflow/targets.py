"""Targets that no rule makes, with the nearest ones that can be made."""

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from itertools import islice, product
from pathlib import Path

from neuma_lib.errors import InputError

_PLAIN = re.compile(r"[A-Za-z0-9_+=.~-]+")  # folders of results, with seeds and options
_TRIED = 300  # combinations of similar words for a target


def requested_targets() -> list[str]:
    """Targets of the command line. Snakemake has them only after it has read the rules."""
    from snakemake.cli import parse_args

    return parse_args(sys.argv[1:])[1].targets


def refuse_unknown(
    targets: Iterable[str],
    rules,
    names: Iterable[str],
    settings_of: Callable[[str], Sequence[str]] = lambda target: (),
) -> None:
    """Raise InputError for the first target that is neither a rule, nor a file that exists or that a rule makes.

    Args:
        targets: of Snakemake's command line.
        rules: of the workflow.
        names: of scenes, methods and others that files may have in their paths.
        settings_of: settings files that the latest run of a target's folder had and this one has not.
    """
    made = [rule for rule in rules if rule.output]
    known = {rule.name for rule in rules}
    words = {*known, *names, *(part for rule in made for part in _fixed_parts(rule))}
    for target in map(str, targets):

        def exists(path: str) -> bool:
            return path in known or any(rule.is_producer(path) for rule in made)

        if exists(target) or Path(target).exists():
            continue
        options = [[part, *_similar(part, words)] for part in target.split("/")]
        tried = dict.fromkeys("/".join(parts) for parts in islice(product(*options), _TRIED))
        near = [path for path in tried if exists(path)][:3]
        if missing := settings_of(target):
            problem = "no rule makes this file with these settings"
            raise InputError(target, problem, f"Add --configfile {' '.join(missing)} --")
        if odd := [part for part in Path(target).parts[1:-1] if not _PLAIN.fullmatch(part)]:
            raise InputError(
                target,
                f"'{odd[0]}' cannot name a folder of results: it may have letters without accents, digits, - and _",
                "Rename the capture's folder, and use the new name here",
            )
        remedy = f"Similar: {', '.join(near)}" if near else "`neuma check` lists scenes and tables"
        raise InputError(target, "no rule makes this file, and it does not exist", remedy)


def _similar(part: str, words: Iterable[str]) -> list[str]:
    """Words like a part of a path, which may have options (``neuma+rank=4``)."""
    name, plus, options = part.partition("+")
    return [word + plus + options for word in get_close_matches(name, words, 3)]


def _fixed_parts(rule) -> set[str]:
    """Names of files and folders without wildcards in the outputs of a rule."""
    return {part for output in rule.output for part in str(output).split("/") if "{" not in part}
