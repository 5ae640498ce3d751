"""The paper's evaluation (Sec. 5) as one command: Table 1, Figures 1 to 3, and what follows from the same trainings.

python -m peps_jax.reproduce table1 figure1 figure2 --out results/reproduce

plan     which trainings and planned routes there are, and how missing ones are made
store    what is kept of each, in files
summary  what the records of several trainings come to: estimates, a line of a table
ways     names for the ways through the navigation domains
driving  the driving study, of which Figure 3 tells

Each result is a module with `needs` and `write`: table1, figure1, figure2, figure3, frontier, queries, ablations, physics.
"""
