"""That PEPS learns what it should, on a domain of the paper's: trained for real, by optimized code in a process of its own."""

import json
import os
import subprocess
import sys

TRAINING = """
import json
import jax
from peps_jax import Config, evaluate, train
from peps_jax.execution.program import stack

def learned(config):
    episodes = evaluate(train(config), 20)
    return episodes.goal_reached, episodes.return_, episodes.explicability, episodes.perceived[0]

sizes = dict(total_steps=20_000, num_queries=3_000)
configs = [Config(env="nav-d4", belief=belief, **sizes) for belief in ("unbiased", "biased")]
found = jax.jit(lambda configs: jax.lax.map(learned, configs))(stack(configs))
print(json.dumps([leaf.tolist() for leaf in found]))
"""


def test_without_bias_peps_takes_the_agents_own_way_and_with_it_the_humans():
    """Sec. 4: what r-hat adds is the bias. On D4 SAC goes over the ice; a human who believes in slipping expects the sand."""
    # nothing of the tests' own settings of JAX, but the same code
    environment = {
        "PATH": "/usr/bin:/bin",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run([sys.executable, "-c", TRAINING], capture_output=True, encoding="utf-8", env=environment)
    assert done.returncode == 0, done.stderr
    goal, returns, explicability, ways = json.loads(done.stdout.splitlines()[-1])
    assert all(map(all, goal))
    left_of_the_diagonal = [max(y - x for x, y in way) > max(x - y for x, y in way) for way in ways]
    assert left_of_the_diagonal == [False, True], "ice, then sand"
    assert explicability[0] == returns[0], "nothing surprises who believes the truth"
    mean = lambda values: sum(values) / len(values)
    assert mean(returns[0]) > mean(returns[1]) + 1
    assert mean(explicability[1]) > 89
