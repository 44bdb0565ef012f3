"""The algorithms that can be asked for by name, each in two settings.

`tuned` is what learns best here; `paper` is section 4 of the paper to the letter.
"""

import dataclasses

from marlyap.algorithm import AbstractAlgorithm
from marlyap.algorithms.masac import MASAC as MASAC
from marlyap.constraints import Lyapunov


def paper(algorithm: AbstractAlgorithm) -> AbstractAlgorithm:
    """Section 4: plain networks, one value for the team, the weight of Delta L learnt."""
    if not isinstance(algorithm, MASAC):
        return algorithm
    constraint = algorithm.constraint
    if isinstance(constraint, Lyapunov):
        constraint = dataclasses.replace(constraint, weight=None)
    return dataclasses.replace(
        algorithm,
        normalise=False,
        heads="team",
        average=1.0,
        reward_scale=1.0,
        constraint=constraint,
    )


PRESETS = {"tuned": lambda algorithm: algorithm, "paper": paper}

ALGORITHMS: dict[str, AbstractAlgorithm] = {
    "masac": MASAC(),
    "masac-lyapunov": MASAC(constraint=Lyapunov()),
}
