"""The names of our own worlds; every other `env.id` is a Gymnasium environment's."""

from __future__ import annotations

POINTMASS = "pointmass"
CLIFFWORLD = "cliffworld"
BANDIT = "bandit"
RANDOM_MDP = "random_mdp"
CHAIN = "chain"

FINITE_WORLDS = (CLIFFWORLD, BANDIT, RANDOM_MDP, CHAIN)  # with numbered states and actions
OWN_WORLDS = (POINTMASS, *FINITE_WORLDS)
