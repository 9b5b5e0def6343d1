"""The guide quotes messages as the code writes them."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs/capture.md"
VALUE = "…"


def texts(path):
    """Literal and formatted strings of a module, with `VALUE` for each inserted value."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else VALUE for part in node.values)


def test_messages_of_mistakes_are_those_of_the_code():
    table = GUIDE.read_text().split("Frequent mistakes")[1].split("\n\n")[1]
    quoted = re.findall(r'"(.+?)" \|$', table, re.MULTILINE)
    assert len(quoted) >= 10
    files = (ROOT / "neuma_lib/capture").rglob("*.py")
    written = "\n".join(text for path in files for text in texts(path))
    unknown = [message for message in quoted if message not in written]
    assert not unknown, unknown
