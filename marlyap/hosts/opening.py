"""`open_game`: a word names a game of another library, and how it is found.

pettingzoo:mpe2.simple_spread_v3     a module with `parallel_env`, PettingZoo's parallel API
mamujoco:Hopper:3x1                  multi-agent MuJoCo of gymnasium-robotics: scenario, split
gymnasium:Hopper-v5                  a Gymnasium environment, as a team of one
vmas:navigation                      a scenario of VMAS
jaxmarl:MPE_simple_spread_v3         an environment of JaxMARL
path/to/file.py:make                 a function of your own that makes a ParallelEnv
"""

from collections.abc import Mapping
from typing import Any

from marlyap.errors import UserError
from marlyap.hosts.copies import SideBySide
from marlyap.hosts.sources import WHOLE, maker
from marlyap.hosts.spec import AbstractHostGame
from marlyap.hosts.workers import Workers


def open_game(
    source: str,
    copies: int,
    workers: int = 0,
    arguments: Mapping[str, Any] | None = None,
    patience: float = 120.0,
) -> AbstractHostGame:
    """So many copies of the game that a word names.

    Arguments: source, as at the head of this file; copies, played side by side; workers, processes
    among which the copies are divided (0: all in this one); arguments, for whoever makes the
    environment; patience, seconds that a process may take for a step.
    Raises UserError for an unknown word, a package that is missing, or an environment that cannot
    be made or has a space that is not a box.
    """
    arguments = dict(arguments or {})
    family = source.partition(":")[0]
    if family in WHOLE:
        if workers:
            raise UserError(f"workers: {family} steps all copies at once; set it to 0.")
        return WHOLE[family](source, copies, arguments)
    if workers:
        return Workers(source, copies, min(workers, copies), arguments, patience)
    return SideBySide(maker(source, arguments), copies)
