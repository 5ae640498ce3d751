"""`python -m peps_jax.human_study`, and `peps-study`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from peps_jax.command_line import called, refuse

PROG = called("peps_jax.human_study", "peps-study")
EXTRA = ("starlette", "statsmodels", "uvicorn")  # what the extra `study` installs


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    try:
        from peps_jax.human_study import commands
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in EXTRA:
            raise
        return refuse(PROG, f"{error.name} isn't installed: pip install 'peps-jax[study]'")
    return commands.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
