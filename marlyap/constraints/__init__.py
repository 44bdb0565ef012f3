"""The constraints that can be asked for by name."""

from marlyap.constraint import Unconstrained as Unconstrained
from marlyap.constraints.lyapunov import Lyapunov as Lyapunov


CONSTRAINTS = {"none": Unconstrained(), "lyapunov": Lyapunov()}
