"""`python -m peps_jax.human_study`."""

import sys

from peps_jax.human_study.commands import main

if __name__ == "__main__":
    sys.exit(main())
