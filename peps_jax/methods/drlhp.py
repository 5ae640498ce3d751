"""DRLHP (Christiano et al. 2017): SAC on r-hat alone, as if the human's answers were about the task.

The teacher, the budget and the choice of queries are PEPS's. That paper's own (Sec. 2.2.1 and 2.2.3): a share 1/e of the
answers, what a member's resample leaves out, validates it and moves its weight decay; and 10 % of the answers count as random.
Its normalisation of every member to mean 0 and standard deviation 1 over what was visited is `level="standard"`. It leaves no
level to r-hat: it was made for tasks without an end, and pays here for staying alive. It sees no reward, so r-hat has no prior.
"""

from __future__ import annotations

from peps_jax.methods.method import register
from peps_jax.methods.preference_based import PREFERENCE_BASED, from_nothing
from peps_jax.settings import Settings


def own_way(settings: Settings) -> Settings:
    """The paper's own likelihood and regularisation."""
    settings = from_nothing(settings)
    return settings.replace(surrogate=settings.surrogate.replace(uniform_answers=0.1, validates=True))


DRLHP = register(PREFERENCE_BASED._replace(name="drlhp", settings=own_way))
