"""`python -m peps_jax.sweep`."""

import sys

from peps_jax.sweep.command import main

if __name__ == "__main__":
    sys.exit(main())
