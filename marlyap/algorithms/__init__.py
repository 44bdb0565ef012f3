"""The algorithms that can be asked for by name, each in two settings.

`tuned` is what learns best here; `paper` is section 4 of the paper to the letter.
"""

import dataclasses

from marlyap.algorithm import AbstractAlgorithm
from marlyap.algorithms.masac import MASAC as MASAC
from marlyap.constraints import Lyapunov


def paper(algorithm: MASAC) -> MASAC:
    """The networks and learning rates of section 4: no LayerNorm, one value for the team."""
    plain = dict(normalise=False, heads="team", average=1.0, reward_scale=1.0, rate_Q=3e-3)
    return dataclasses.replace(algorithm, **plain)


PRESETS = {"tuned": lambda algorithm: algorithm, "paper": paper}

ALGORITHMS: dict[str, AbstractAlgorithm] = {
    "masac": MASAC(),
    "masac-lyapunov": MASAC(constraint=Lyapunov()),
}
