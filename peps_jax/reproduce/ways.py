"""Names for the ways that routes take through the navigation domains, and which of them the paper's Figure 2 shows."""

from __future__ import annotations

import numpy as np

import peps_envs

PAPER = {  # of Figure 2
    "peps": {"nav-d1": "detour", "nav-d2": "below", "nav-d3": "ice", "nav-d4": "sand"},
    "sac": {"nav-d1": "along the pit", "nav-d2": "corridor", "nav-d3": "ice", "nav-d4": "ice"},
}
CLEARANCE = 0.6  # between a detour and a way along the pit, on average


def way(domain: str, places: np.ndarray, arrived: bool) -> str:
    """The name of the way that `places` (steps + 1, 2) take through a domain; "none" if it didn't arrive.

    D1: a detour if its clearance past the pit is above `CLEARANCE`. D2: below the pit, or through the corridor above it. D3, D4:
    over the sand or the ice, by the side of the diagonal on which the way keeps its largest distance.
    """
    if not arrived:
        return "none"
    x, y = places.T
    if domain in ("nav-d1", "nav-d2"):
        left, low, right, high = np.asarray(peps_envs.make(domain).params.pit)
        past = y[(x > left) & (x < right)]
        if domain == "nav-d1":
            return "detour" if past.mean() - high > CLEARANCE else "along the pit"
        return "below" if past.mean() > low else "corridor"
    return "sand" if (y - x).max() > (x - y).max() else "ice"
