"""A page on which a user marks the object of a capture, or a known length, in its photographs."""

import html
import json
from pathlib import Path
from urllib.parse import quote

from neuma_lib.errors import InputError
from neuma_lib.io.files import write_text
from neuma_lib.project.capture_folder import HEIF, read_capture


def write_select_page(folder: str | Path) -> Path:
    """Write `select.html` into a capture's folder and return its path. It shows the photographs of this folder.

    A click or a rectangle becomes the line `object` of capture.yaml, two clicks become `length`, in pixels of the
    displayed photographs.

    Raises:
        InputError: the folder is not that of a capture, or has no photographs that a browser shows.
    """
    capture = read_capture(folder)
    names = [path.name for path in capture.photographs if path.suffix.lower() not in HEIF]
    if not names:
        raise InputError(folder, "it has no photographs that a browser shows", "Convert them to JPEG")
    page = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    parts = {
        "TITLE": html.escape(capture.folder.name),
        "FILES": _script(names),
        "FOLDER": _script(quote(capture.settings.photographs)),
    }
    for key, value in parts.items():
        page = page.replace(f"@{key}@", value)
    path = capture.folder / "select.html"
    write_text(path, page)
    return path


def _script(value: object) -> str:
    """JSON inside a script element."""
    return json.dumps(value).replace("<", "\\u003c")
