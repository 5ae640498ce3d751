"""Digests of code: what is kept of a computation is valid for the code that made it, and for no other."""

from __future__ import annotations

import ast
import functools
import importlib.util
from pathlib import Path

from peps_jax.storage import files

PACKAGES = ("peps_envs", "peps_jax")  # whose code counts; other packages' versions are told apart by number


@functools.cache
def digest(*modules: str) -> str:
    """SHA-256 of the sources of `modules` and of all that they import from `PACKAGES`, directly or not."""
    return files.json_digest({name: _source(name).read_text(encoding="utf-8") for name in sorted(closure(*modules))})


def closure(*modules: str) -> set[str]:
    """The modules that `modules` import from `PACKAGES`, directly or not, anywhere in their code; and they themselves."""
    found: set[str] = set()
    waiting = set(modules)
    while waiting:
        name = waiting.pop()
        found.add(name)
        waiting |= imports(name, _source(name)) - found
    return found


def imports(module: str, source: Path) -> set[str]:
    """The modules of `PACKAGES` that the file `source` of `module` imports."""
    package = module if source.name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            found |= {
                inner if _is_module(inner) else base for inner in (f"{base}.{alias.name}" for alias in node.names)
            }
    return {name for name in found if name.split(".")[0] in PACKAGES}


def _is_module(name: str) -> bool:
    return name.split(".")[0] in PACKAGES and _path(name) is not None


def _source(module: str) -> Path:
    path = _path(module)
    if path is None:
        raise ValueError(f"module {module!r} has no source: name one of {', '.join(PACKAGES)}")
    return path


@functools.cache
def _path(module: str) -> Path | None:
    """The file of a module, found without importing it; None if there is none."""
    root, *inner = module.split(".")
    spec = importlib.util.find_spec(root)
    if spec is None or spec.origin is None:
        return None
    place = Path(spec.origin).parent.joinpath(*inner)
    candidates = (place / "__init__.py", place.with_suffix(".py"))
    return next((path for path in candidates if path.is_file()), None)
