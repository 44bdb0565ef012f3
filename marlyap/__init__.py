"""Train decentralised controllers for teams, hold them to a Lyapunov condition, measure them.

The names below are imported on first use, so that `import marlyap` costs nothing.
"""

import sys
from importlib import import_module


TYPE_CHECKING = False  # `typing` takes longer to import than all that a command's start needs
if TYPE_CHECKING:
    from marlyap.algorithm import AbstractOffPolicy as AbstractOffPolicy
    from marlyap.algorithms import APG as APG, MASAC as MASAC
    from marlyap.certificate import AbstractCertificate as AbstractCertificate
    from marlyap.certify import certify as certify
    from marlyap.constraint import AbstractConstraint as AbstractConstraint
    from marlyap.constraints import Lyapunov as Lyapunov, Unconstrained as Unconstrained
    from marlyap.controllers import AbstractController as AbstractController
    from marlyap.dynamics import (
        AbstractDynamics as AbstractDynamics,
        DoubleIntegrator as DoubleIntegrator,
        LateUnicycle as LateUnicycle,
        SingleIntegrator as SingleIntegrator,
        Unicycle as Unicycle,
    )
    from marlyap.errors import UserError as UserError
    from marlyap.evaluation import compare as compare, evaluate as evaluate
    from marlyap.fit import train as train
    from marlyap.game import (
        AbstractGame as AbstractGame,
        AbstractRegulation as AbstractRegulation,
        Tolerance as Tolerance,
    )
    from marlyap.lyapunov_function import AbstractLyapunov as AbstractLyapunov
    from marlyap.physics import AbstractPlant as AbstractPlant
    from marlyap.planar import AbstractPlanar as AbstractPlanar, Goals as Goals
    from marlyap.rollout import Decentralised as Decentralised, rollout as rollout
    from marlyap.run import Run as Run
    from marlyap.runs.launch import Launch as Launch, launch as launch
    from marlyap.tasks import Formation as Formation, Rendezvous as Rendezvous
    from marlyap.trainer import Schedule as Schedule, Trainer as Trainer
    from marlyap.types import State as State

PUBLIC = {
    "algorithm": ("AbstractOffPolicy",),
    "algorithms": ("APG", "MASAC"),
    "certificate": ("AbstractCertificate",),
    "certify": ("certify",),
    "constraint": ("AbstractConstraint",),
    "constraints": ("Lyapunov", "Unconstrained"),
    "controllers": ("AbstractController",),
    "dynamics": (
        "AbstractDynamics",
        "DoubleIntegrator",
        "LateUnicycle",
        "SingleIntegrator",
        "Unicycle",
    ),
    "errors": ("UserError",),
    "evaluation": ("compare", "evaluate"),
    "fit": ("train",),
    "game": ("AbstractGame", "AbstractRegulation", "Tolerance"),
    "physics": ("AbstractPlant",),
    "planar": ("AbstractPlanar", "Goals"),
    "lyapunov_function": ("AbstractLyapunov",),
    "rollout": ("Decentralised", "rollout"),
    "run": ("Run",),
    "runs.launch": ("Launch", "launch"),
    "tasks": ("Formation", "Rendezvous"),
    "trainer": ("Schedule", "Trainer"),
    "types": ("State",),
}
_HOME = {name: module for module, names in PUBLIC.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("marlyap")
    if name not in _HOME:
        raise AttributeError(f"module 'marlyap' has no attribute '{name}'")
    value = getattr(import_module(f"marlyap.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


class _Package(type(sys)):
    def __setattr__(self, name: str, value: object) -> None:
        """Leave `marlyap.certify` the function when Python has imported the module of that name."""
        if not (name in _HOME and isinstance(value, type(sys))):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
