"""An independent checker of certificates: NumPy in float64, and nothing of what made them."""

from marlyap.recheck.checker import recheck as recheck
from marlyap.recheck.reader import Rejected as Rejected
