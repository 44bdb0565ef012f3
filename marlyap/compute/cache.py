"""Where compiled programs are kept between starts. Nothing here imports JAX."""

import os
import sys
import warnings
from pathlib import Path


def enable_cache(programs: bool) -> str | None:
    """Keep what XLA compiles and, with `programs`, what JAX traces (`export_cache`).

    Settings of the user's own stay as they are: the environment variables
    JAX_COMPILATION_CACHE_DIR and MARLYAP_PROGRAMS, and `jax.config.jax_compilation_cache_dir`.
    Returns why nothing can be kept, in one line, where this is so.
    """
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    jax = sys.modules.get("jax")
    configured = jax.config.jax_compilation_cache_dir if jax else None
    folder = Path(configured or os.environ.get("JAX_COMPILATION_CACHE_DIR") or cache_directory())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError
    except OSError:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        if jax:
            jax.config.update("jax_enable_compilation_cache", False)
        return f"cache: {folder} cannot be written; every start compiles again."
    if not configured:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # small ones too
        if jax:
            seconds = float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)
    if programs:
        os.environ.setdefault("MARLYAP_PROGRAMS", str(folder / "programs"))
    return None


def cache_directory() -> Path:
    """Where they are kept unless the user says otherwise."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "marlyap" / "jax"
