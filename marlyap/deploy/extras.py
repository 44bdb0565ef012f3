"""Packages that only some of this needs, imported where they are used."""

from importlib import import_module
from typing import Any

from marlyap.errors import UserError


def needs(package: str, what: str, named: str = "") -> Any:
    """The package. Raises UserError, which says how to install it, where it is missing.

    Arguments: package, to import; what needs it; named, its name for pip where that is another.
    """
    try:
        return import_module(package)
    except ImportError:
        raise UserError(
            f"{what} needs {named or package}; install it with pip install 'marlyap[robots]'."
        ) from None
