"""How a peer's script is called and what it answers, the same for all.

    python peers/sb3_sac.py --width 64 --steps 4000 [--wait]

It warms up (imports, compiles, fills its replay), then takes the time of `steps` environment steps and prints one line of JSON:
{"steps": ..., "seconds": ..., "preparation": seconds before}. With `--wait` it says "ready" when it is warm and starts the
timed part at the next line of its input, so that several processes run it at the same time.
"""

import argparse
import json
import sys
import time

STARTED = time.perf_counter()

# what every SAC does alike; the discount and the targets' rate are peps_jax's
NUM_ENVS = 16
UPDATES_PER_VECTOR_STEP = 4  # of 16 environments: one update for every 4 environment steps
BATCH = 256
LEARNING_RATE = 1e-3
DISCOUNT = 0.995
TARGET_RATE = 0.01
HORIZON = 200
# where the time to a return is taken
LEVEL = 80.0  # return of who arrives, and takes some 25 steps instead of 8
WATCHED_EVERY = 5  # rounds


def arguments(description: str) -> argparse.Namespace:
    """The command line of a script that trains."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--width", type=int, default=64, help="units in each of the two hidden layers")
    parser.add_argument("--steps", type=int, default=4_000, help="environment steps that are timed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wait", action="store_true", help='say "ready" when warm, and wait for a line of input')
    return parser.parse_args()


def get_ready(wait: bool) -> float:
    """Waits for the others if it has to; returns the seconds that preparing took."""
    preparation = time.perf_counter() - STARTED
    if wait:
        print("ready", flush=True)
        sys.stdin.readline()
    return preparation


def report(steps: int, seconds: float, preparation: float) -> None:
    """The script's answer."""
    print(json.dumps({"steps": steps, "seconds": seconds, "preparation": preparation}), flush=True)
