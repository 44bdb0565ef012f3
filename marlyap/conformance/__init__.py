"""What every game must obey."""

from marlyap.conformance.laws import conformance as conformance, shapes as shapes
