"""Command lines, called in the tests' own process, and what they leave."""

from collections.abc import Callable, Sequence
from pathlib import Path

from peps_jax.sweep import results


def exit_code(main: Callable[..., int], *arguments: object) -> int:
    """What a command line ends with: `main`'s result, or the code that argparse leaves with."""
    try:
        return main([*map(str, arguments)])
    except SystemExit as exit:
        return exit.code


def is_one_complaint(captured, prog: str, parts: Sequence[str]) -> bool:
    """Whether all that was printed is one line on stderr, and it holds `parts`."""
    told = captured.err
    return (
        told.startswith(f"{prog}: error: ")
        and told.count("\n") == 1
        and all(part in told for part in parts)
        and not captured.out
    )


def contents(folder: Path) -> dict[str, bytes]:
    """What a sweep's folder has to say: all its files but the manifest, which holds times."""
    found = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    found.pop(results.MANIFEST, None)
    return {name: path.read_bytes() for name, path in found.items()}


def everything(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder, by its path inside; folders are None."""
    found = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in found}
