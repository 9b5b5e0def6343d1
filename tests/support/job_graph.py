"""What several tests share of graph."""

import re


def jobs(plan: str) -> list[tuple[str, list[str], list[str]]]:
    """Rule, inputs and outputs of every job of a dry run."""
    found = []
    for rule, said in re.findall(r"^(?:local)?rule (\w+):\n((?:    .*\n)*)", plan, re.MULTILINE):
        listed = dict(re.findall(r"^    (input|output): (.*)$", said, re.MULTILINE))
        found.append((rule, *(listed.get(key, "").split(", ") for key in ("input", "output"))))
    return found
