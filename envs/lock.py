"""Write the locked environments from the extras in pyproject.toml and the versions in pins.txt: `make lock`.

requirements.txt          the workflow and Blender: everything but captures and the viewer's server
requirements-dev.txt      the same with the tools for tests and style checks
requirements-capture.txt  requirements.txt with the packages for captures
requirements-viewer.txt   requirements.txt with the packages for the viewer's server
requirements-docs.txt     requirements.txt with the packages for the site
requirements-engines.txt  requirements.txt with other engines and finite elements
conda.yaml, conda-capture.yaml  the same packages in a conda environment with Python 3.11, untested

A version that is already in one of these files is kept while it satisfies the pins; `make lock UPGRADE=--upgrade`
replaces dependencies by their newest versions. Local builds (``+cpu``) and the addresses of package indices are left
out, so that the files resolve anywhere.
"""

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent
HEADER = "# Written by `make lock` from pyproject.toml and pins.txt; do not edit.\n"
RUN = ("workflow", "blender")
EXTRAS = {
    "requirements.txt": RUN,
    "requirements-dev.txt": (*RUN, "dev"),
    "requirements-capture.txt": (*RUN, "capture"),
    "requirements-viewer.txt": (*RUN, "viewer"),
    "requirements-docs.txt": (*RUN, "docs"),
    "requirements-engines.txt": (*RUN, "engines"),
}
CONDA = {"conda.yaml": "requirements.txt", "conda-capture.yaml": "requirements-capture.txt"}
OPTIONS = (
    "--quiet --no-header --no-annotate --strip-extras --no-emit-index-url --no-emit-find-links "
    "--no-emit-trusted-host --allow-unsafe --resolver=backtracking"
).split()


def resolve(file: str, options: list[str]) -> list[str]:
    """Exact requirements of an environment, one a line, sorted. Every file but the first agrees with the first."""
    first = next(iter(EXTRAS))
    constraints = ["pins.txt"] if file == first else ["pins.txt", first]
    with TemporaryDirectory() as folder:
        output = Path(folder, "output.txt")
        if (HERE / file).is_file():
            output.write_text((HERE / file).read_text())  # the versions to keep
        command = [sys.executable, "-m", "piptools", "compile", *OPTIONS, f"--output-file={output}", *options]
        command += [f"--extra={extra}" for extra in EXTRAS[file]]
        command += [f"--constraint={HERE / name}" for name in constraints]
        done = subprocess.run([*command, "pyproject.toml"], cwd=HERE.parent, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        pins = re.findall(r"^([A-Za-z0-9._-]+)==([^\s+;]+)", output.read_text(), re.MULTILINE)
    return sorted({f"{name.lower()}=={version}" for name, version in pins})


def main() -> None:
    for file in EXTRAS:
        packages = resolve(file, sys.argv[1:])
        (HERE / file).write_text(HEADER + "".join(f"{line}\n" for line in packages))
        print(f"{file}: {len(packages)} packages")
    for file, source in CONDA.items():
        lines = (HERE / source).read_text().removeprefix(HEADER).splitlines()
        pins = "".join(f"      - {line}\n" for line in lines)
        (HERE / file).write_text(
            f"{HEADER}channels:\n  - conda-forge\ndependencies:\n  - python=3.11\n  - pip\n  - pip:\n{pins}"
        )


if __name__ == "__main__":
    main()
