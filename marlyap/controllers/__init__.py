"""Controllers that are not learnt, to compare with: built in, or in a file of your own."""

from marlyap.controllers.agreement import (
    ConsensusFilter as ConsensusFilter,
    Laplacian as Laplacian,
)
from marlyap.controllers.cart_feedback import CartFeedback as CartFeedback, CartLQR as CartLQR
from marlyap.controllers.cascade import Cascade as Cascade
from marlyap.controllers.controller import (
    AbstractController as AbstractController,
    as_action as as_action,
)
from marlyap.controllers.droop import Droop as Droop, SteepDroop as SteepDroop
from marlyap.controllers.flocking import (
    Alignment as Alignment,
    Braking as Braking,
    FreeFlock as FreeFlock,
    OlfatiSaber as OlfatiSaber,
    Tanner as Tanner,
)
from marlyap.controllers.formation_feedback import (
    FormationConsensus as FormationConsensus,
    FormationFeedback as FormationFeedback,
)
from marlyap.controllers.gradient import GradientConsensus as GradientConsensus
from marlyap.controllers.grid_feedback import GridFeedback as GridFeedback
from marlyap.controllers.lin_francis_maggiore import LinFrancisMaggiore as LinFrancisMaggiore
from marlyap.controllers.lloyd import Lloyd as Lloyd
from marlyap.controllers.optimal import OptimalControl as OptimalControl, Replayed as Replayed
from marlyap.controllers.platoon_feedback import (
    PlatoonLinear as PlatoonLinear,
    PlatoonOVM as PlatoonOVM,
)
from marlyap.controllers.point_offset import PointOffset as PointOffset
from marlyap.controllers.pursuit import (
    PointPursuit as PointPursuit,
    TreePursuit as TreePursuit,
)
from marlyap.controllers.quad_chain import (
    QuadChain as QuadChain,
    QuadChainSpace as QuadChainSpace,
)
from marlyap.controllers.reference import (
    Hold as Hold,
    UniformlyRandom as UniformlyRandom,
    Zero as Zero,
)
from marlyap.controllers.ring_feedback import (
    FollowerStopper as FollowerStopper,
    RingHuman as RingHuman,
    RingLinear as RingLinear,
)
from marlyap.controllers.voltage_droop import (
    DeadBand as DeadBand,
    LinearVoltage as LinearVoltage,
    MildDeadBand as MildDeadBand,
)


CONTROLLERS: dict[str, type[AbstractController]] = {
    "point-offset": PointOffset,
    "gradient-consensus": GradientConsensus,
    "lin-francis-maggiore": LinFrancisMaggiore,
    "tree-pursuit": TreePursuit,
    "point-pursuit": PointPursuit,
    "optimal-control": OptimalControl,
    "formation-consensus": FormationConsensus,
    "formation-linear": FormationFeedback,
    "cart-lqr": CartLQR,
    "cart-feedback": CartFeedback,
    "grid-feedback": GridFeedback,
    "platoon-ovm": PlatoonOVM,
    "platoon-linear": PlatoonLinear,
    "quad-chain": QuadChain,
    "quad-chain-space": QuadChainSpace,
    "laplacian": Laplacian,
    "consensus-filter": ConsensusFilter,
    "droop": Droop,
    "steep-droop": SteepDroop,
    "follower-stopper": FollowerStopper,
    "ring-linear": RingLinear,
    "ring-human": RingHuman,
    "dead-band": DeadBand,
    "dead-band-mild": MildDeadBand,
    "linear-voltage": LinearVoltage,
    "lloyd": Lloyd,
    "olfati-saber": OlfatiSaber,
    "olfati-saber-free": FreeFlock,
    "alignment": Alignment,
    "tanner": Tanner,
    "braking": Braking,
    "zero": Zero,
    "hold": Hold,
    "uniform": UniformlyRandom,
}


def names_a_controller(word: str) -> bool:
    """Whether a controller is meant: a built-in name, or path/to/file.py:Name."""
    return word in CONTROLLERS or word.rpartition(":")[0].endswith(".py")
