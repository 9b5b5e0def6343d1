"""What a result was made from: digests of settings, of inputs, and of the code behind a script.

`code_digest` answers "would this script behave differently now?", so that an edit of the rasterizer reruns what
renders and nothing else. It covers the script and every module of the library that the script imports, directly or
through others (grimp's import graph): their syntax without docstrings, so comments, layout and documentation are free,
and data files of the same stem (``compositor.cu`` next to ``compositor.py``). ``from a.b import c`` reaches the module
a.b.c if there is one, else a.b; the ``__init__`` of a package counts only where a name is imported from it.
"""

import ast
import hashlib
import json
from collections.abc import Iterable, Mapping, Set
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import grimp

from neuma_lib.io.files import sha256_file
from neuma_lib.mechanics.catalogue import DEFINED_IN

PACKAGES = ("neuma_lib", "studies")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
DIGITS = 16  # hexadecimal digits of a digest


class Sources:
    """The modules of a package as they stand when they are first read."""

    def __init__(self, *packages: str):
        self._packages = packages or PACKAGES
        self._root = Path(next(iter(find_spec(self._packages[0]).submodule_search_locations))).parent
        self._digests: dict[str, str] = {}

    @cached_property
    def _graph(self) -> grimp.ImportGraph:
        return grimp.build_graph(*self._packages, cache_dir=None, exclude_type_checking_imports=True)

    def reached(self, script: Path, modules: tuple[str, ...] = ()) -> list[str]:
        """Names of some modules, and of those that they and a script import, directly or through others, sorted.

        Args:
            modules: of the library, of other packages, or Python files.
        """
        own = self._graph.modules
        files = [script, *(_file_of(module) for module in modules if module not in own)]
        direct = (own & set(modules)).union(*(_imports(file, own) for file in files))
        through = (self._graph.find_upstream_modules(module) for module in direct)
        return sorted(direct.union(*through))

    def digest(self, script: Path, modules: tuple[str, ...] = ()) -> str:
        """Digest of a script and of all modules that it reaches, and of further modules that it loads by name."""
        parts = [
            _file_digest(script),
            *(
                f"{name} {_file_digest(_file_of(name))}"
                for name in modules
                if name not in self._graph.modules
            ),
            *(f"{name} {self._module_digest(name)}" for name in self.reached(script, modules)),
        ]
        return _hash("\n".join(parts).encode())

    def _module_digest(self, name: str) -> str:
        if name not in self._digests:
            base = self._root.joinpath(*name.split("."))
            module = base / "__init__.py" if base.is_dir() else base.with_name(f"{base.name}.py")
            files = {module, *(f for f in module.parent.glob(f"{module.stem}.*") if f.is_file())}
            self._digests[name] = " ".join(_file_digest(file) for file in sorted(files))
        return self._digests[name]


@cache
def _library() -> Sources:
    return Sources()


@cache
def code_digest(script: str | Path, *modules: str) -> str:
    """Digest of a script and of all that it reaches of the library, read once a process.

    Args:
        modules: of the library, of other packages, or Python files, which the script loads by name.
    """
    return _library().digest(Path(script), modules)


def digest_of_files(modules: Iterable[str]) -> str:
    """Digest of Python files, and of modules that are not of the library."""
    return _hash("\n".join(_file_digest(_file_of(module)) for module in sorted(modules)).encode())


def law_files(value: Any) -> set[str]:
    """Files of the laws in nested plain values that are not built in."""
    if isinstance(value, Mapping):
        named = {file for (_, name), file in DEFINED_IN.items() if value.get("name") == name}
        return named.union(*map(law_files, value.values()))
    return set().union(*map(law_files, value)) if isinstance(value, list | tuple) else set()


def fingerprint(settings: Mapping[str, Any], inputs: Mapping[str, str | Path], code: str) -> dict[str, str]:
    """What a checkpoint must agree with: digests of settings (one a key), of input files, and of the code.

    Args:
        settings: plain nested values.
        inputs: files by name.
        code: result of `code_digest`.
    """
    stamps = {"code": code}
    for key, value in settings.items():
        text = json.dumps(value, sort_keys=True)
        stamps[f"setting {key}"] = text if len(text) <= 40 else _hash(text.encode())
    return stamps | {f"input {name}": sha256_file(path)[:DIGITS] for name, path in inputs.items()}


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:DIGITS]


def _file_of(module: str) -> Path:
    """The file of a module that is not of the library, or the Python file itself."""
    return Path(module if module.endswith(".py") else find_spec(module).origin)


def _file_digest(path: Path) -> str:
    """Digest of the syntax of a Python file, and of the bytes of any other."""
    if path.suffix != ".py":
        return _hash(path.read_bytes())
    tree = ast.parse(path.read_text(), filename=str(path))
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return _hash(ast.dump(tree).encode())


def _imports(path: Path, modules: Set[str]) -> set[str]:
    """Those of some modules that a Python file imports itself."""
    imported = set()
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = (f"{node.module}.{alias.name}" for alias in node.names)
            imported |= {name if name in modules else node.module for name in inner}
    return imported & modules
