"""Shields: a game in which a policy may do worse than a stable base law only on credit."""

from marlyap.shields.plan import Plan as Plan
from marlyap.shields.shield import Shield as Shield
from marlyap.shields.shielded import Shielded as Shielded, behind as behind, split as split
