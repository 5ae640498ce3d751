"""The paper's evaluation (Sec. 5) as one command: Table 1, Figures 1 to 3, and what follows from the same trainings.

python -m peps_jax.reproduce table1 figure1 figure2 --out results/reproduce

store    what is kept of each training, in files
study    which trainings and plans there are, and how missing ones are made
tables   Table 1 and the ablations
figures  Figures 1 and 2, the frontier and the queries
driving  Figure 3, the driving study
"""
