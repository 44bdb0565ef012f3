"""The certificates by name, configured."""

from marlyap.certificate import AbstractCertificate
from marlyap.certificates.basin import Basin
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay


CERTIFICATES: dict[str, AbstractCertificate] = {
    "reach": Reach(),
    "reach-and-stay": ReachAndStay(),
    "decrease": Decrease(),
    "contraction": Contraction(),
    "basin": Basin(),
    "quantiles": Quantiles(),
}
