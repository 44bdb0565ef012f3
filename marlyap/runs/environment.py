"""What JAX reads from the environment when it is imported. Nothing here imports JAX."""

import os

from marlyap.compute.cache import enable_cache


PLATFORMS = {"cpu": "cpu", "gpu": "cuda"}  # JAX's names


def prepare(device: str | None = None, core: int | None = None, training: bool = True) -> str:
    """Set the device, the caches and, for training, one thread; pin this process to one core.

    Call it before JAX is imported. Returns why compiled programs cannot be kept, in one line, or
    "" where they can.
    """
    if device is not None:
        os.environ["JAX_PLATFORMS"] = PLATFORMS[device]
    if training:
        os.environ.setdefault("NPROC", "1")  # products this small lose time to a second thread
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    return enable_cache(programs=training) or ""
