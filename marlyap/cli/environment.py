"""What has to be set before JAX is imported, and is said on the command line."""

from marlyap.cli.common import say
from marlyap.errors import UserError
from marlyap.runs import environment


def prepare(device: str | None = None, training: bool = False) -> None:
    """Set what JAX reads when it is imported. Every verb that needs JAX calls this first."""
    if trouble := environment.prepare(device, training=training):
        say(f"marlyap: {trouble}")
    if device:
        find_device(device)


def find_device(device: str) -> None:
    """Raise UserError where JAX does not see the device that was asked for."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # JAX asserts where the platform has no plugin
        raise UserError(
            f"device: JAX finds no {device} here; leave out --device, or install JAX for it, as "
            "in pip install 'jax[cuda13]'."
        ) from None
