"""Versions of Python and of packages whose updates change results, as installed now and in the logs of jobs."""

import importlib.metadata
import platform
import re
from collections import Counter
from pathlib import Path

PACKAGES = ("torch", "warp-lang", "numpy", "bpy", "pycolmap")
_LINE = re.compile(r"versions: (.*)")
_HEAD = 2000  # bytes at the start of a log that contain the line


def installed() -> dict[str, str]:
    """Versions of Python and of the packages that are installed, by name."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def line() -> str:
    """The installed versions as a line of a log, which `changes` reads."""
    return "versions: " + ", ".join(f"{name} {version}" for name, version in installed().items())


def changes(results: Path) -> list[str]:
    """Each version that jobs of a results folder ran with and that is not installed now, one line each."""
    now, count = installed(), 0
    former: Counter[tuple[str, str]] = Counter()
    for log in (results / "logs").rglob("*.log"):
        with open(log, "rb") as file:
            match = _LINE.search(file.read(_HEAD).decode(errors="replace"))
        count += bool(match)
        used = (entry.partition(" ") for entry in match[1].split(", ")) if match else ()
        former.update((name, version) for name, _, version in used if now.get(name) != version)
    remedy = "To repeat them, delete them, or run snakemake with --forceall. To keep them, install the former version"
    return [
        f"{results}: {number} of {count} jobs ran with {name} {version}, but {name} {now.get(name, '(none)')} is "
        f"installed, whose results can differ. {remedy}"
        for (name, version), number in sorted(former.items())
    ]
