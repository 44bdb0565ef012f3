"""An independent checker of certificates: NumPy in float64, and nothing of what made them."""

from marlyap.recheck.checker import Rejected as Rejected, recheck as recheck
