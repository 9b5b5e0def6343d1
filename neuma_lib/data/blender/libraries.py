"""Explanation of missing libraries of Blender's Python module."""

import re
import subprocess
import sys

from neuma_lib.errors import InputError

DEBIAN_PACKAGES = (
    "libx11-6 libxext6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1 libegl1 "
    "libglu1-mesa libgomp1 libwayland-client0"
)
"""Debian and Ubuntu packages with the shared libraries that bpy needs even without a display."""


def explain_import_error(text: str) -> InputError | None:
    """The error that explains an import error of Blender in ``text``, with packages to install; None without one."""
    missing = re.search(r"ImportError: (\S+): cannot open shared object file", text)
    if missing:
        remedy = f"Run `apt-get install {DEBIAN_PACKAGES}`, or install the package that contains it"
        return InputError("Blender (bpy)", f"needs the system library {missing.group(1)}", remedy)
    if re.search(r"ModuleNotFoundError: No module named 'bpy'", text):
        return InputError(
            "Blender (bpy)",
            "the Python module is not installed (bpy 4.5 needs Python 3.11)",
            'Install it with `make env` or `pip install "neuma[blender]"` and run with that interpreter, or set '
            "NEUMA_BLENDER_PYTHON to one that has it",
        )
    return None


def main() -> int:
    """Try to load Blender in a separate process, and print what is missing: ``make check``."""
    tried = subprocess.run([sys.executable, "-c", "import bpy"], capture_output=True, text=True)
    if tried.returncode == 0:
        return 0
    print(explain_import_error(tried.stderr) or tried.stderr.strip(), file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
