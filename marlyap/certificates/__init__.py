"""The certificates by name, configured. `Proof` is not listed: it needs a region."""

from marlyap.certificates.basin import Basin
from marlyap.certificates.certificate import AbstractCertificate
from marlyap.certificates.closed_form import ClosedForm
from marlyap.certificates.composition import Composition
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.ellipsoid import Ellipsoid
from marlyap.certificates.linearisation import Linearisation
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certificates.safety import Apart, Safe
from marlyap.certificates.shielded import Shielded
from marlyap.certificates.theorem1 import Theorem1


CERTIFICATES: dict[str, AbstractCertificate] = {
    "reach": Reach(),
    "reach-and-stay": ReachAndStay(),
    "decrease": Decrease(),
    "contraction": Contraction(),
    "basin": Basin(),
    "quantiles": Quantiles(),
    "safe": Safe(),
    "apart": Apart(),
    "robustness": Robustness(),
    "theorem1": Theorem1(),
    "composition": Composition(),
    "linearisation": Linearisation(),
    "shielded": Shielded(),  # for games behind a shield only
    "ellipsoid": Ellipsoid(),
    "closed-form": ClosedForm(),  # for the point-offset law only
}
