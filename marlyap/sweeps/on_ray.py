"""Units on a Ray cluster: Ray decides where and when, the folders say what became of them.

The folder of the sweep has to be on a file system that all nodes share. Without an address a Ray
of this machine alone is started, and ends with this process.
"""

import time
from contextlib import suppress
from typing import Any

from marlyap.errors import UserError
from marlyap.sweeps.engine import Ended, alone, missing
from marlyap.sweeps.unit import Unit


class OnRay:
    """One CPU a unit, as many at once as the cluster has."""

    def __init__(self, slots: int | None = None, options: dict[str, str] | None = None):
        try:
            import ray  # pyright: ignore[reportMissingImports] -- an extra
        except ImportError:
            raise missing("ray", "ray", "on: ray") from None
        self.ray: Any = ray
        given = dict(options or {})
        address, cpus = given.pop("address", None), given.pop("num_cpus", None)
        gpus = float(given.pop("gpus", 0))
        if given:
            raise UserError(f"engine: ray knows address, num_cpus and gpus, not {[*given][0]}.")
        try:
            ray.init(
                address=address,
                num_cpus=int(cpus) if cpus else None,
                log_to_driver=False,
                include_dashboard=False if address is None else None,
                logging_level="error",
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UserError(f"engine: Ray could not be reached ({error}).") from None
        self.remote = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=0)(alone)
        self.slots = slots or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self.active: dict[Any, Unit] = {}

    def start(self, unit: Unit) -> None:
        self.active[self.remote.remote(unit.to_json())] = unit

    def ended(self, seconds: float) -> list[Ended]:
        if not self.active:
            time.sleep(seconds)
            return []
        ready, _ = self.ray.wait([*self.active], timeout=seconds, num_returns=1)
        found = []
        for ref in ready:
            try:
                says = self.ray.get(ref)
            except self.ray.exceptions.RayError as error:
                says = f"Ray lost its process ({type(error).__name__})"
            found.append(Ended(self.active.pop(ref), says))
        return found

    def stop(self) -> None:
        for ref in self.active:
            self.ray.cancel(ref)
        with suppress(self.ray.exceptions.RayError):
            self.ray.wait([*self.active], num_returns=max(1, len(self.active)), timeout=60)
        self.ray.shutdown()
