"""What a result was made from: digests of settings, inputs and of the code that a script reaches.

`code_digest` answers the question "would this script behave differently now?" by walking imports, so that editing
the rasterizer reruns what renders and nothing else. Rules of the walk:

- A digest covers the abstract syntax of a module, without docstrings: comments, layout and documentation are free.
- ``import a.b.c`` and ``from a.b.c import name`` reach the module a.b.c, and all that it imports, anywhere in it.
- ``from package import name`` reaches what ``name`` is in the package: a submodule, a definition of its
  ``__init__``, or the module that the ``__init__`` takes it from. Other re-exports of that ``__init__`` are not
  reached, although Python runs them.
- `CATALOGUES` are modules that everything imports a little of (readers and writers, settings). Of these only the
  names that are used count, with all that those use in turn.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from neuma_lib.io.files import sha256_file

PACKAGE = "neuma_lib"
CATALOGUES = frozenset({"neuma_lib.io.files", "neuma_lib.config.settings"})


def code_digest(script: str | Path, root: str | Path) -> str:
    """Digest of a script and of all that it reaches of the package below ``root`` (16 hex digits).

    Args:
        script: Python file.
        root: folder that contains the package.
    """
    return _Walk(Path(root).resolve()).of_script(Path(script)).hexdigest()


def reached_modules(script: str | Path, root: str | Path) -> list[str]:
    """Names of the package's modules that a script reaches, sorted."""
    walk = _Walk(Path(root).resolve())
    walk.of_script(Path(script))
    return sorted(walk.reached)


def fingerprint(settings: Any, inputs: Mapping[str, str | Path], code: str) -> dict[str, str]:
    """What a checkpoint must agree with: digests of settings (one a key), of input files, and of the code.

    Args:
        settings: plain nested values.
        inputs: files by name.
        code: result of `code_digest`.
    """
    stamps = {"code": code}
    for key, value in (settings if isinstance(settings, Mapping) else {"settings": settings}).items():
        text = json.dumps(value, sort_keys=True)
        stamps[f"setting {key}"] = text if len(text) <= 40 else hashlib.sha256(text.encode()).hexdigest()[:16]
    for name, path in inputs.items():
        stamps[f"input {name}"] = sha256_file(path)[:16]
    return stamps


class _Walk:
    """A walk over the imports of one script."""

    def __init__(self, root: Path):
        self.root = root
        self.reached: dict[str, set[str] | None] = {}  # module -> names used of it; None: all of it
        self._queue: list[tuple[str, str | None]] = []

    def of_script(self, script: Path) -> _Digest:
        tree = _parse(script, script.stat().st_mtime_ns)
        digest = _Digest()
        digest.add(script.name, tree.body)
        self._follow(tree.body, module=None)
        while self._queue:
            self._visit(*self._queue.pop())
        for module in sorted(self.reached):
            names, tree = self.reached[module], self._tree(module)
            digest.add(module, tree.body if names is None else _used(tree, names)[0])
        return digest

    def _visit(self, module: str, name: str | None) -> None:
        """Reach one name of a module, or all of it."""
        done = self.reached.get(module, set())
        if done is None or (name is not None and name in done):
            return
        tree = self._tree(module)
        is_package = self._file(module).name == "__init__.py"
        if name is None or not (module in CATALOGUES or is_package):
            self.reached[module] = None
            self._follow(tree.body, module)
            return
        self.reached[module] = {*done, name}
        self._follow(_used(tree, {name})[0], module)

    def _follow(self, statements: Iterable[ast.stmt], module: str | None) -> None:
        for node in (n for s in statements for n in ast.walk(s)):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    if self._file(alias.name):
                        self._queue.append((alias.name, None))
            elif isinstance(node, ast.ImportFrom):
                source = self._source(node, module)
                if source is None or not self._file(source):
                    continue
                for alias in node.names:
                    inner = f"{source}.{alias.name}"
                    if self._file(inner):
                        self._queue.append((inner, None))
                    else:
                        self._queue.append((source, None if alias.name == "*" else alias.name))

    def _source(self, node: ast.ImportFrom, module: str | None) -> str | None:
        """Absolute name of the module in ``from module import ...``."""
        if not node.level:
            return node.module
        if module is None:
            return None
        package = module.split(".") if self._file(module).name == "__init__.py" else module.split(".")[:-1]
        package = package[: len(package) - node.level + 1]
        return ".".join([*package, *([node.module] if node.module else [])])

    def _file(self, module: str | None) -> Path | None:
        if not module or module.split(".")[0] != PACKAGE:
            return None
        base = self.root.joinpath(*module.split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file():
                return path
        return None

    def _tree(self, module: str) -> ast.Module:
        path = self._file(module)
        return _parse(path, path.stat().st_mtime_ns)


class _Digest:
    """Running digest of named lists of statements."""

    def __init__(self):
        self._hash = hashlib.sha256()

    def add(self, name: str, statements: Iterable[ast.stmt]) -> None:
        self._hash.update(name.encode())
        for statement in statements:
            self._hash.update(ast.dump(statement).encode())

    def hexdigest(self) -> str:
        return self._hash.hexdigest()[:16]


@cache
def _parse(path: Path, _mtime: int) -> ast.Module:
    """Syntax tree without docstrings; parsed once a process and version of the file."""
    tree = ast.parse(path.read_text(), filename=str(path))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
            if isinstance(body[0].value.value, str):
                del body[0]
    return tree


def _used(tree: ast.Module, names: Iterable[str]) -> tuple[list[ast.stmt], set[str]]:
    """Top-level statements that define ``names`` or what those use in turn, in the order of the file.

    Statements that bind nothing (and are no ``__main__`` block) always count.
    """
    binds = [(statement, _bound(statement)) for statement in tree.body]
    wanted, chosen = set(names), set()
    pending = list(wanted)
    for i, (statement, bound) in enumerate(binds):
        if not bound and not (isinstance(statement, ast.If) and "__main__" in ast.dump(statement.test)):
            chosen.add(i)
            pending += [n for n in _mentioned(statement) if n not in wanted]
            wanted.update(pending)
    while pending:
        name = pending.pop()
        for i, (statement, bound) in enumerate(binds):
            if i not in chosen and name in bound:
                chosen.add(i)
                fresh = _mentioned(statement) - wanted
                wanted |= fresh
                pending += fresh
    statements = []
    for i in sorted(chosen):
        statement = binds[i][0]
        if isinstance(statement, ast.Import | ast.ImportFrom):
            kept = [a for a in statement.names if _alias(a) in wanted or a.name in ("*", "annotations")]
            statement = type(statement)(**{**dict(ast.iter_fields(statement)), "names": kept})
        statements.append(statement)
    return statements, wanted


def _alias(alias: ast.alias) -> str:
    return alias.asname or alias.name.split(".")[0]


def _bound(statement: ast.stmt) -> set[str]:
    """Names that a top-level statement defines."""
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {_alias(a) for a in statement.names}
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    return {n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def _mentioned(statement: ast.stmt) -> set[str]:
    return {n.id for n in ast.walk(statement) if isinstance(n, ast.Name)}
