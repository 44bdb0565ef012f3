"""The algorithms that have a name, each in two settings.

`tuned` is what learns best here; `paper` is section 4 of the paper to the letter, and for the
references, which the paper does not have, the same networks and numbers.
"""

from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms.apg import APG as APG
from marlyap.learning.algorithms.maddpg import MADDPG as MADDPG
from marlyap.learning.algorithms.masac import MASAC as MASAC
from marlyap.learning.algorithms.sac import (
    CentralisedSAC as CentralisedSAC,
    DecentralisedSAC as DecentralisedSAC,
)
from marlyap.learning.constraints import Lyapunov


PRESETS = {"tuned": lambda algorithm: algorithm, "paper": lambda algorithm: algorithm.paper()}

ALGORITHMS: dict[str, AbstractAlgorithm] = {
    "masac": MASAC(),
    "masac-lyapunov": MASAC(constraint=Lyapunov()),
    "masac-nstep": MASAC(n_step=5),
    # Han et al. 2020 for many agents, and what it owes to its critic alone.
    "lac": MASAC(use_Q=False, constraint=Lyapunov()),
    "critic-only": MASAC(use_Q=False, constraint=Lyapunov(reading="critic", weight=1.0)),
    # The checker of types takes the abstract fields of their base for arguments.
    "decentralised-sac": DecentralisedSAC(),  # pyright: ignore[reportCallIssue]
    "centralised-sac": CentralisedSAC(),  # pyright: ignore[reportCallIssue]
    "maddpg": MADDPG(),
    "apg": APG(),
    "apg-lyapunov": APG(weight=1.0),
    "matd3": MADDPG(critics=2, smoothing=0.2, delay=2),
}
