"""Train decentralised controllers for teams, hold them to a Lyapunov condition, measure them.

The names below are imported on first use, so that `import marlyap` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any


if TYPE_CHECKING:
    from marlyap.algorithms import APG as APG, MASAC as MASAC
    from marlyap.constraints import Lyapunov as Lyapunov, Unconstrained as Unconstrained
    from marlyap.dynamics import (
        DoubleIntegrator as DoubleIntegrator,
        LateUnicycle as LateUnicycle,
        SingleIntegrator as SingleIntegrator,
        Unicycle as Unicycle,
    )
    from marlyap.errors import UserError as UserError
    from marlyap.evaluation import compare as compare, evaluate as evaluate
    from marlyap.fit import train as train
    from marlyap.game import AbstractGame as AbstractGame
    from marlyap.rollout import Decentralised as Decentralised
    from marlyap.run import Run as Run
    from marlyap.tasks import Formation as Formation, Rendezvous as Rendezvous
    from marlyap.trainer import Schedule as Schedule, Trainer as Trainer
    from marlyap.types import State as State

PUBLIC = {
    "algorithms": ("APG", "MASAC"),
    "constraints": ("Lyapunov", "Unconstrained"),
    "dynamics": ("DoubleIntegrator", "LateUnicycle", "SingleIntegrator", "Unicycle"),
    "errors": ("UserError",),
    "evaluation": ("compare", "evaluate"),
    "fit": ("train",),
    "game": ("AbstractGame",),
    "rollout": ("Decentralised",),
    "run": ("Run",),
    "tasks": ("Formation", "Rendezvous"),
    "trainer": ("Schedule", "Trainer"),
    "types": ("State",),
}
_HOME = {name: module for module, names in PUBLIC.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'marlyap' has no attribute '{name}'")
    value = getattr(import_module(f"marlyap.{_HOME[name]}"), name)
    globals()[name] = value
    return value
