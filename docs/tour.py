# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A quick tour
#
# This page is a script and a notebook: run `python docs/tour.py`, or make a notebook of it with
# `jupytext --to ipynb docs/tour.py`. It takes two minutes on two cores, and writes its two pictures to `results/tour`.

# %%
# %matplotlib inline
from pathlib import Path

import jax
import numpy as np

import peps_envs
from peps_jax import Config, evaluate, grid, train
from peps_jax.analysis.surrogate_maps import rank_correlation, surrogate_values
from peps_jax.drawing.navigation_map import draw_heat, draw_map, draw_route, draw_start
from peps_jax.drawing.panels import panels_of

folder = Path("results/tour")
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## A domain, and what a human believes about it
#
# In D4 a wall is in the way. Over the ice it takes ten steps to the goal; over the sand, which slows the agent down, thirteen.

# %%
task = peps_envs.make("nav-d4")
print(list(task.beliefs))

# %% [markdown]
# The human is wrong about both: believes that one slips on ice, and is hardly slower on sand. What is believed is a value of the
# same parameters as what is true.

# %%
biased = task.beliefs["biased"]
for name in ("ice_noise", "ice_gain", "sand_gain"):
    print(f"{name:10} true {getattr(task.params, name):.2f}   believed {getattr(biased, name):.2f}")

# %% [markdown]
# ## Training
#
# A `Config` is one training. `grid` makes a batch of it, whose trainings differ in what is named; here in λ, the weight of
# explicability against return. At λ = 0 PEPS is SAC. Both trainings are one compiled program.

# %%
config = Config(env="nav-d4", total_steps=20_000)
trainings = grid(config, lam=np.array([0.0, 2.4]))
results = jax.jit(jax.vmap(train))(trainings)

# %% [markdown]
# ## Evaluation
#
# Explicability is Σ r_H + Σ (ℓ_H − ℓ_A): what an episode is worth to the human, less how much it surprises the human more than it
# should. It is at most the return here, for the human's reward is the agent's own and only the belief is biased.

# %%
scores = jax.jit(jax.vmap(lambda result: evaluate(result, 20)))(results)
for place, lam in enumerate(trainings.lam):
    returned, explicable = scores.return_[place].mean(), scores.explicability[place].mean()
    print(f"lambda {lam:.1f}: return {returned:.1f}, explicability {explicable:.1f}")

# %% [markdown]
# ## Routes
#
# Without explicability the agent takes the ice. With it, it takes the way that the human expects.

# %%
figure, panels = panels_of(1, 2, 3.0, 3.0)
for place, axes in enumerate(panels[0]):
    draw_map(axes, task.params)
    for route, length in zip(scores.perceived[place][:3], scores.length[place][:3], strict=True):
        draw_route(axes, np.asarray(route)[: int(length) + 1], "peps" if place else "sac", alpha=0.8)
    draw_start(axes, task.params)
    axes.set_title(f"λ = {trainings.lam[place]:.1f}")
figure.savefig(folder / "routes.png")
figure

# %% [markdown]
# ![Routes of PEPS and SAC in D1 and D4](routes.png)
#
# ## What was learned about the human
#
# r̂ knows nothing of the human but the answers to which of two pieces of a trajectory is preferred. Beside it is what it should be
# up to a scale: the true ℓ_H + r_H, averaged over directions of walking.

# %%
explicable = jax.tree.map(lambda leaf: leaf[1], results)  # the training at λ = 2.4
learned, true, free = surrogate_values(explicable)
print(f"rank correlation {rank_correlation(learned[free], true[free]):.2f}")

figure, panels = panels_of(1, 2, 3.4, 2.9)
for axes, values, title in zip(panels[0], (learned, true), ("learned r̂", "true ℓ_H + r_H"), strict=True):
    draw_heat(figure, axes, np.where(free, values, np.nan), task.params)
    axes.set_title(title)
figure.savefig(folder / "surrogate.png")
figure

# %% [markdown]
# ![The learned surrogate reward beside the true one](surrogate.png)
#
# From here: [environments and beliefs](environments.md), [methods and settings](methods.md), [what came out](results.md).
