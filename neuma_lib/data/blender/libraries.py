"""Explanation of missing libraries of Blender's Python module."""

from __future__ import annotations

import re
import subprocess
import sys

from neuma_lib.errors import InputError

DEBIAN_PACKAGES = {
    "libX11.so": "libx11-6",
    "libXext.so": "libxext6",
    "libXrender.so": "libxrender1",
    "libXxf86vm.so": "libxxf86vm1",
    "libXfixes.so": "libxfixes3",
    "libXi.so": "libxi6",
    "libxkbcommon.so": "libxkbcommon0",
    "libSM.so": "libsm6",
    "libICE.so": "libice6",
    "libGL.so": "libgl1",
    "libEGL.so": "libegl1",
    "libGLU.so": "libglu1-mesa",
    "libgomp.so": "libgomp1",
    "libwayland-client.so": "libwayland-client0",
}
"""Shared library that bpy needs even without a display -> Debian/Ubuntu package."""

EVERYTHING = "libx11-6 libxext6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1"


def explain_import_error(text: str) -> InputError | None:
    """The error that explains an import error of Blender in ``text``, with the package to install; None without one."""
    missing = re.search(r"ImportError: (\S+): cannot open shared object file", text)
    if missing:
        library = missing.group(1)
        problem = f"needs the system library {library}"
        package = next((p for stem, p in DEBIAN_PACKAGES.items() if library.startswith(stem)), None)
        if package is None:
            remedy = f"Install the package that contains it (on Debian: apt-file search {library})."
            return InputError("Blender (bpy)", problem, remedy)
        remedy = f"Run `apt-get install {package}`, or, for all libraries of Blender, `apt-get install {EVERYTHING}`"
        return InputError("Blender (bpy)", problem, remedy)
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
