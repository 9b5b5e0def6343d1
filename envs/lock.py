"""Write the locked environments from the pins in pyproject.toml: `make lock`.

requirements.txt      everything that the workflow needs, exact versions
requirements-dev.txt  the same, and what tests and style checks need
requirements-capture.txt  the same as the first, and what own photographs and videos need
requirements-viewer.txt  the same as the first, and what the viewer's server needs
conda.yaml            requirements.txt inside a conda environment with Python 3.11 (`snakemake --sdm conda`, not tried)
conda-capture.yaml    requirements-capture.txt so

Local builds (``+cpu``) and the addresses of package indices are left out, so that the files resolve anywhere.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
HEADER = "# Made by `make lock` from the pins in pyproject.toml; do not edit.\n"


def resolve(extras: list[str]) -> list[str]:
    """Exact requirements of the project with some extras, one a line, sorted."""
    command = [
        sys.executable,
        "-m",
        "piptools",
        "compile",
        "--quiet",
        "--dry-run",
        "--no-header",
        "--no-annotate",
    ]
    command += ["--strip-extras", "--no-emit-index-url", "--no-emit-find-links", "--no-emit-trusted-host"]
    command += ["--allow-unsafe", "--resolver=backtracking", "--output-file=-"]
    command += [f"--extra={extra}" for extra in extras]
    done = subprocess.run([*command, "pyproject.toml"], cwd=HERE.parent, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    found = re.findall(r"^([A-Za-z0-9._-]+)==([^\s+;]+)", done.stdout + done.stderr, re.MULTILINE)
    return sorted({f"{name.lower()}=={version}" for name, version in found})


def main() -> None:
    run, dev, capture, viewer = resolve([]), resolve(["dev"]), resolve(["capture"]), resolve(["viewer"])
    for kind, packages in (("", run), ("-dev", dev), ("-capture", capture), ("-viewer", viewer)):
        (HERE / f"requirements{kind}.txt").write_text(HEADER + "".join(f"{line}\n" for line in packages))
    for name, packages in (("conda.yaml", run), ("conda-capture.yaml", capture)):
        pins = "".join(f"      - {line}\n" for line in packages)
        (HERE / name).write_text(
            f"{HEADER}channels:\n  - conda-forge\ndependencies:\n  - python=3.11\n  - pip\n  - pip:\n{pins}"
        )
    print(
        f"{len(run)} packages, {len(dev)} with those of development, {len(capture)} with those of captures, "
        f"{len(viewer)} with those of the viewer"
    )


if __name__ == "__main__":
    main()
