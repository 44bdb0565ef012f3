"""The constraints that can be asked for by name."""

from marlyap.learning.constraint import Unconstrained as Unconstrained
from marlyap.learning.constraints.lyapunov import Lyapunov as Lyapunov


CONSTRAINTS = {"none": Unconstrained(), "lyapunov": Lyapunov()}
