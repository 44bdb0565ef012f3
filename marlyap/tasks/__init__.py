"""The tasks that can be asked for by name: configured objects, so a name is a preset."""

from marlyap.games.dynamics import LateUnicycle, Unicycle
from marlyap.games.perturbed import Perturbed
from marlyap.tasks.cartpoles import CartPoles as CartPoles
from marlyap.tasks.consensus import Averaging, Consensus as Consensus
from marlyap.tasks.coverage import Coverage as Coverage
from marlyap.tasks.estimation import Estimation as Estimation
from marlyap.tasks.flock import Flock as Flock
from marlyap.tasks.formation import Formation as Formation
from marlyap.tasks.formation_di import DisplacementFormation as DisplacementFormation
from marlyap.tasks.frequency import Frequency as Frequency, SwingEquations
from marlyap.tasks.gnn_flock import GnnFlock as GnnFlock
from marlyap.tasks.microgrid import Microgrid as Microgrid
from marlyap.tasks.platoon import Platoon as Platoon
from marlyap.tasks.quads_planar import PlanarFormation as PlanarFormation
from marlyap.tasks.quads_space import SpaceFormation as SpaceFormation
from marlyap.tasks.rendezvous import Rendezvous as Rendezvous
from marlyap.tasks.ring import Ring as Ring
from marlyap.tasks.runaway import Runaway as Runaway
from marlyap.tasks.voltage import PowerFlow, Voltage as Voltage


TASKS = {
    "rendezvous": Rendezvous(),
    "rendezvous-path5": Rendezvous(agents=5, graph="path"),
    "rendezvous-hard": Rendezvous(agents=5, graph="path", dynamics=Unicycle(limits=(2.0, 2.0))),
    "rendezvous-late": Rendezvous(dynamics=LateUnicycle()),
    "rendezvous-rest": Rendezvous(rest_weight=0.03, horizon=60),
    "runaway": Runaway(),
    "rendezvous-robust": Perturbed(  # pyright: ignore[reportCallIssue] -- the rest is inner's
        inner=Rendezvous(), drop=0.2, silent=0.5, late=0.05, measured=0.01
    ),
    "formation": Formation(),
    "formation-di": DisplacementFormation(),
    "cartpoles": CartPoles(),
    "microgrid": Microgrid(),
    "platoon-catchup": Platoon(),
    "platoon-slowdown": Platoon(start_headway=(1.0, 1.0), start_speed=(1.5, 2.5)),
    "platoon-long": Platoon(16, start_headway=(1.0, 1.0), start_speed=(1.5, 2.5)),
    "quads-planar": PlanarFormation(),
    "quads-space": SpaceFormation(),
    "consensus": Consensus(),
    "consensus-unstable": Consensus(plant=Averaging(growth=1.1)),
    "estimation": Estimation(),
    "frequency": Frequency(),
    "frequency-weak": Frequency(plant=SwingEquations(damping=10 * (-0.2,))),
    "frequency-step": Frequency(load_step=0.5),
    "ring": Ring(),
    "ring2": Ring(agents=2),
    "voltage13": Voltage(),
    "voltage33": Voltage(
        agents=6,
        plant=PowerFlow(limits=(1.0,), buses="33", inverters=(12, 17, 21, 24, 28, 32)),
    ),
    "coverage": Coverage(),
    "coverage-bump": Coverage(bump=True),
    "flock": Flock(),
    "gnn-flock": GnnFlock(),
    "gnn-flock-slow": GnnFlock(speed=1.0),
}
