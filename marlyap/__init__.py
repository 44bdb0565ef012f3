"""Train decentralised controllers for teams, hold them to a Lyapunov condition, measure them.

The names below are imported on first use, so that `import marlyap` costs nothing.
"""

from importlib import import_module


TYPE_CHECKING = False  # `typing` takes longer to import than all that a command's start needs
if TYPE_CHECKING:
    from marlyap.certificates.certificate import AbstractCertificate as AbstractCertificate
    from marlyap.certificates.certify import certify as certify
    from marlyap.certificates.lyapunov import AbstractLyapunov as AbstractLyapunov
    from marlyap.controllers import AbstractController as AbstractController, as_action as as_action
    from marlyap.controllers.predicting import Predicting as Predicting
    from marlyap.errors import UserError as UserError
    from marlyap.games.dynamics import (
        AbstractDynamics as AbstractDynamics,
        DoubleIntegrator as DoubleIntegrator,
        LateUnicycle as LateUnicycle,
        SingleIntegrator as SingleIntegrator,
        Unicycle as Unicycle,
        UnstablePoint as UnstablePoint,
    )
    from marlyap.games.game import (
        AbstractGame as AbstractGame,
        AbstractRegulation as AbstractRegulation,
        Tolerance as Tolerance,
    )
    from marlyap.games.perturbed import Perturbed as Perturbed
    from marlyap.games.physics import AbstractPlant as AbstractPlant
    from marlyap.games.planar import AbstractPlanar as AbstractPlanar, Goals as Goals
    from marlyap.games.sensing import beside as beside, beside_entries as beside_entries
    from marlyap.learning.algorithm import (
        AbstractAlgorithm as AbstractAlgorithm,
        AbstractFromData as AbstractFromData,
    )
    from marlyap.learning.algorithms import (
        APG as APG,
        MADDPG as MADDPG,
        MASAC as MASAC,
        CentralisedSAC as CentralisedSAC,
        DecentralisedSAC as DecentralisedSAC,
    )
    from marlyap.learning.constraint import AbstractConstraint as AbstractConstraint
    from marlyap.learning.constraints import Lyapunov as Lyapunov, Unconstrained as Unconstrained
    from marlyap.learning.off_policy import AbstractOffPolicy as AbstractOffPolicy
    from marlyap.learning.on_policy import AbstractOnPolicy as AbstractOnPolicy
    from marlyap.learning.replay import Episode as Episode
    from marlyap.learning.schedule import Schedule as Schedule
    from marlyap.learning.source import (
        AbstractSource as AbstractSource,
        CostWindow as CostWindow,
        Play as Play,
        Simulated as Simulated,
    )
    from marlyap.learning.trainer import Trainer as Trainer
    from marlyap.report.curves import plot_sweep as plot_sweep
    from marlyap.report.paper import plot as plot
    from marlyap.runs.fit import train as train
    from marlyap.runs.launch import Launch as Launch, launch as launch
    from marlyap.runs.run import Run as Run, load_policy as load_policy
    from marlyap.shields import Shield as Shield, Shielded as Shielded
    from marlyap.simulation.evaluation import (
        Evaluation as Evaluation,
        compare as compare,
        evaluate as evaluate,
    )
    from marlyap.simulation.rollout import (
        AbstractExplorer as AbstractExplorer,
        Decentralised as Decentralised,
        rollout as rollout,
    )
    from marlyap.sweeps.folder import Sweep as Sweep
    from marlyap.sweeps.go import make_sweep as make_sweep, run_sweep as run_sweep
    from marlyap.sweeps.plan import Plan as Plan
    from marlyap.tasks import Formation as Formation, Rendezvous as Rendezvous
    from marlyap.types import (
        Action as Action,
        Entry as Entry,
        Key as Key,
        Links as Links,
        Obs as Obs,
        Scene as Scene,
        State as State,
        Trajectory as Trajectory,
        Transition as Transition,
    )

PUBLIC = {
    "certificates.certificate": ("AbstractCertificate",),
    "certificates.certify": ("certify",),
    "certificates.lyapunov": ("AbstractLyapunov",),
    "controllers": ("AbstractController", "as_action"),
    "controllers.predicting": ("Predicting",),
    "errors": ("UserError",),
    "games.dynamics": (
        "AbstractDynamics",
        "DoubleIntegrator",
        "LateUnicycle",
        "SingleIntegrator",
        "Unicycle",
        "UnstablePoint",
    ),
    "games.game": ("AbstractGame", "AbstractRegulation", "Tolerance"),
    "games.perturbed": ("Perturbed",),
    "games.physics": ("AbstractPlant",),
    "games.planar": ("AbstractPlanar", "Goals"),
    "games.sensing": ("beside", "beside_entries"),
    "learning.algorithm": ("AbstractAlgorithm", "AbstractFromData"),
    "learning.algorithms": ("APG", "CentralisedSAC", "DecentralisedSAC", "MADDPG", "MASAC"),
    "learning.constraint": ("AbstractConstraint",),
    "learning.constraints": ("Lyapunov", "Unconstrained"),
    "learning.off_policy": ("AbstractOffPolicy",),
    "learning.on_policy": ("AbstractOnPolicy",),
    "learning.replay": ("Episode",),
    "learning.schedule": ("Schedule",),
    "learning.source": ("AbstractSource", "CostWindow", "Play", "Simulated"),
    "learning.trainer": ("Trainer",),
    "report.paper": ("plot",),
    "runs.fit": ("train",),
    "runs.launch": ("Launch", "launch"),
    "runs.run": ("Run", "load_policy"),
    "shields": ("Shield", "Shielded"),
    "simulation.evaluation": ("Evaluation", "compare", "evaluate"),
    "simulation.rollout": ("AbstractExplorer", "Decentralised", "rollout"),
    "report.curves": ("plot_sweep",),
    "sweeps.folder": ("Sweep",),
    "sweeps.go": ("make_sweep", "run_sweep"),
    "sweeps.plan": ("Plan",),
    "tasks": ("Formation", "Rendezvous"),
    "types": (
        "Action",
        "Entry",
        "Key",
        "Links",
        "Obs",
        "Scene",
        "State",
        "Trajectory",
        "Transition",
    ),
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
