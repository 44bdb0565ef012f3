"""Hand-written controllers, to compare with. `CONTROLLERS[name](game)` is one of them."""

from marlyap.controllers.cascade import Cascade as Cascade
from marlyap.controllers.controller import AbstractController as AbstractController
from marlyap.controllers.gradient import GradientConsensus as GradientConsensus
from marlyap.controllers.lin_francis_maggiore import LinFrancisMaggiore as LinFrancisMaggiore
from marlyap.controllers.optimal import OptimalControl as OptimalControl, Replayed as Replayed
from marlyap.controllers.point_offset import PointOffset as PointOffset
from marlyap.controllers.pursuit import TreePursuit as TreePursuit


CONTROLLERS: dict[str, type[AbstractController]] = {
    "point-offset": PointOffset,
    "gradient-consensus": GradientConsensus,
    "lin-francis-maggiore": LinFrancisMaggiore,
    "tree-pursuit": TreePursuit,
    "optimal-control": OptimalControl,
}
