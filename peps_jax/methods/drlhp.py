"""DRLHP (Christiano et al. 2017): SAC on r-hat alone, as if the human's answers were about the task.

The teacher, the budget and the choice of queries are PEPS's. That paper's own (Sec. 2.2.1 and 2.2.3): every member of the
ensemble is normalised by itself, to mean 0 and a fixed standard deviation over what was visited; a share 1/e of the answers,
what a member's resample leaves out, validates it and moves its weight decay; and 10 % of the answers count as random. Its
normalisation leaves no level to r-hat: it was made for tasks without an end. `DRLHP_UNSCALED` leaves the normalisation out, so
that r-hat keeps the level and the scale that the answers give it.
"""

from __future__ import annotations

from peps_jax.learning.surrogate import Recipe
from peps_jax.methods import preference_based

RECIPE = Recipe(level="standard", uniform_answers=0.1, validates=True)

DRLHP = preference_based.method("drlhp", rewards=(preference_based.reward,), recipe=RECIPE)
DRLHP_UNSCALED = preference_based.method(
    "drlhp_unscaled", rewards=(preference_based.reward,), recipe=RECIPE._replace(level="none")
)
