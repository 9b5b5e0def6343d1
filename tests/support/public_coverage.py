"""Coverage of the public functions: `python -m tests.support.public_coverage coverage.json`, after `make coverage`.

Public are the names of `neuma_lib` and the names without underscore of the modules on the pages docs/api. Lists the
functions below 90 %, and fails if all of them together are below.
"""

import inspect
import json
import re
import sys
from importlib import import_module
from pathlib import Path

import neuma_lib

ROOT = Path(__file__).resolve().parents[2]
GOAL = 90.0


def public_names() -> set[tuple[str, str]]:
    """File, relative to the root, and qualified name of each public function and class."""
    named = [getattr(neuma_lib, name) for name in neuma_lib.__all__]
    for page in (ROOT / "docs/api").glob("*.md"):
        for name in re.findall(r"^::: (neuma_lib\S+)", page.read_text(), re.MULTILINE):
            if (ROOT / name.replace(".", "/")).with_suffix(".py").exists():
                module = import_module(name)
                members = {key: value for key, value in vars(module).items() if not key.startswith("_")}
                named += [value for value in members.values() if getattr(value, "__module__", "") == name]
            else:
                module, _, name = name.rpartition(".")
                named.append(getattr(import_module(module), name))
    routines = [value for value in named if inspect.isclass(value) or inspect.isroutine(value)]
    return {(v.__module__.replace(".", "/") + ".py", v.__qualname__) for v in map(inspect.unwrap, routines)}


def is_public(file: str, function: str, names: set[tuple[str, str]]) -> bool:
    """Whether a function of a report is a public name, or a public or special method of a public class."""
    owner, _, name = function.rpartition(".")
    return (file, function) in names or ((file, owner) in names and re.match(r"__|[^_]", name) is not None)


def main(report: str) -> int:
    names = public_names()
    rows = []
    for file, entry in json.loads(Path(report).read_text())["files"].items():
        for function, region in entry["functions"].items():
            summary = region["summary"]
            if function and summary["num_statements"] and is_public(file, function, names):
                rows.append((file, function, summary["covered_lines"], summary["num_statements"]))
    for file, function, covered, count in sorted(rows):
        if 100 * covered < GOAL * count:
            print(f"{file}: {function}: {covered} of {count} statements")
    total = 100 * sum(row[2] for row in rows) / max(1, sum(row[3] for row in rows))
    print(f"{len(rows)} public functions: {total:.1f} % of their statements, goal {GOAL:g} %")
    return int(total < GOAL)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
