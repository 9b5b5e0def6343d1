"""What to install when Blender's Python module cannot be loaded."""

from __future__ import annotations

import re
import subprocess
import sys

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
"""Shared libraries that bpy needs even without a display, and the Debian/Ubuntu package of each."""

EVERYTHING = "libx11-6 libxext6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1"


def explain_import_error(text: str) -> str:
    """One sentence that says what to install for the import error in ``text``; empty if there is none."""
    missing = re.search(r"ImportError: (\S+): cannot open shared object file", text)
    if missing:
        library = missing.group(1)
        package = next((p for stem, p in DEBIAN_PACKAGES.items() if library.startswith(stem)), None)
        if package is None:
            return (
                f"Blender (bpy) needs the system library {library}: install the package that holds it "
                f"(on Debian: apt-file search {library})."
            )
        return (
            f"Blender (bpy) needs the system library {library}: install the Debian package {package}, for example "
            f"`apt-get install {package}`; all that Blender needs: `apt-get install {EVERYTHING}`."
        )
    if re.search(r"ModuleNotFoundError: No module named 'bpy'", text):
        return (
            "Blender's Python module is not installed. bpy 4.5 needs Python 3.11: install it with `make env` or "
            '`pip install "neuma[blender]"` and run with that interpreter, or name one that has it in '
            "NEUMA_BLENDER_PYTHON."
        )
    return ""


def main() -> int:
    """Try to load Blender in a process of its own and say what is missing: ``make check``."""
    tried = subprocess.run([sys.executable, "-c", "import bpy"], capture_output=True, text=True)
    if tried.returncode == 0:
        return 0
    print(explain_import_error(tried.stderr) or tried.stderr.strip(), file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
