"""Physics in which people's beliefs are wrong in ways that have been measured: tasks on small MuJoCo models, stepped by MJX.

A module for each, with its models' XML and `domain()`, which makes the environment, its true model, and beliefs. The registry
names them and imports one when its task is made, because MuJoCo and MJX take a second.
"""
