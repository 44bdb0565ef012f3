"""Train decentralised controllers for teams, hold them to a Lyapunov condition, measure them.

The names below are imported on first use, so that `import marlyap` costs nothing.
"""

from importlib import import_module


TYPE_CHECKING = False  # `typing` takes longer to import than all that a command's start needs
if TYPE_CHECKING:
    from marlyap.certificates.certificate import AbstractCertificate as AbstractCertificate
    from marlyap.certificates.certify import certify as certify
    from marlyap.certificates.lyapunov import AbstractLyapunov as AbstractLyapunov
    from marlyap.controllers import AbstractController as AbstractController
    from marlyap.errors import UserError as UserError
    from marlyap.games.dynamics import (
        AbstractDynamics as AbstractDynamics,
        DoubleIntegrator as DoubleIntegrator,
        LateUnicycle as LateUnicycle,
        SingleIntegrator as SingleIntegrator,
        Unicycle as Unicycle,
    )
    from marlyap.games.game import (
        AbstractGame as AbstractGame,
        AbstractRegulation as AbstractRegulation,
        Tolerance as Tolerance,
    )
    from marlyap.games.physics import AbstractPlant as AbstractPlant
    from marlyap.games.planar import AbstractPlanar as AbstractPlanar, Goals as Goals
    from marlyap.learning.algorithm import AbstractAlgorithm as AbstractAlgorithm
    from marlyap.learning.algorithms import APG as APG, MASAC as MASAC
    from marlyap.learning.constraint import AbstractConstraint as AbstractConstraint
    from marlyap.learning.constraints import Lyapunov as Lyapunov, Unconstrained as Unconstrained
    from marlyap.learning.off_policy import AbstractOffPolicy as AbstractOffPolicy
    from marlyap.learning.on_policy import AbstractOnPolicy as AbstractOnPolicy
    from marlyap.learning.schedule import Schedule as Schedule
    from marlyap.learning.source import AbstractSource as AbstractSource, Simulated as Simulated
    from marlyap.learning.trainer import Trainer as Trainer
    from marlyap.runs.fit import train as train
    from marlyap.runs.launch import Launch as Launch, launch as launch
    from marlyap.runs.run import Run as Run
    from marlyap.simulation.evaluation import compare as compare, evaluate as evaluate
    from marlyap.simulation.rollout import Decentralised as Decentralised, rollout as rollout
    from marlyap.tasks import Formation as Formation, Rendezvous as Rendezvous
    from marlyap.types import State as State

PUBLIC = {
    "learning.algorithm": ("AbstractAlgorithm",),
    "learning.algorithms": ("APG", "MASAC"),
    "certificates.certificate": ("AbstractCertificate",),
    "certificates.certify": ("certify",),
    "learning.constraint": ("AbstractConstraint",),
    "learning.constraints": ("Lyapunov", "Unconstrained"),
    "controllers": ("AbstractController",),
    "games.dynamics": (
        "AbstractDynamics",
        "DoubleIntegrator",
        "LateUnicycle",
        "SingleIntegrator",
        "Unicycle",
    ),
    "errors": ("UserError",),
    "simulation.evaluation": ("compare", "evaluate"),
    "runs.fit": ("train",),
    "games.game": ("AbstractGame", "AbstractRegulation", "Tolerance"),
    "games.physics": ("AbstractPlant",),
    "games.planar": ("AbstractPlanar", "Goals"),
    "certificates.lyapunov": ("AbstractLyapunov",),
    "learning.off_policy": ("AbstractOffPolicy",),
    "learning.on_policy": ("AbstractOnPolicy",),
    "simulation.rollout": ("Decentralised", "rollout"),
    "runs.run": ("Run",),
    "runs.launch": ("Launch", "launch"),
    "learning.schedule": ("Schedule",),
    "learning.source": ("AbstractSource", "Simulated"),
    "tasks": ("Formation", "Rendezvous"),
    "learning.trainer": ("Trainer",),
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
