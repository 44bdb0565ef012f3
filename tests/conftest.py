"""Strict settings, a cache of compiled code, and what many tests share.

Nothing of marlyap may be imported at the top of this file: pytest loads it before jaxtyping starts
to check the package, and what is imported by then stays unchecked (test_floors.py notices).
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest


jax.config.update("jax_numpy_rank_promotion", "raise")


def keep_compiled_code():
    """Compile once, not once a run: in JAX_COMPILATION_CACHE_DIR, else ~/.cache/marlyap/jax."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    where = os.environ.get("JAX_COMPILATION_CACHE_DIR") or Path(cache, "marlyap", "jax")
    try:
        Path(where).mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(where))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


keep_compiled_code()


@pytest.fixture(autouse=True, scope="session")
def single_precision():
    """The package runs in float32; a test that needs more says `with jax.enable_x64(True)`."""
    assert not jax.config.jax_enable_x64


def shaken(tree, seed=0, by=0.3):
    """The same tree with noise on every float, so that no two parts of it are equal by birth."""
    rng = np.random.default_rng(seed)

    def shake(leaf):
        if not isinstance(leaf, jax.Array) or not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return leaf + by * jnp.asarray(rng.standard_normal(leaf.shape), leaf.dtype)

    return jax.tree.map(shake, tree)


def same(a, b):
    """Whether two trees are equal to the last bit, shapes and types included."""
    raw = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    arrays = lambda t: [np.asarray(raw(x)) for x in jax.tree.leaves(t) if isinstance(x, jax.Array)]
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()
        for x, y in zip(arrays(a), arrays(b), strict=True)
    )


def close(a, b, rtol=1e-5, atol=1e-6):
    """Assert that two trees are close, leaf by leaf."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


@pytest.fixture(scope="session")
def game():
    """A small rendezvous on which agent 2 does not see the leader."""
    from marlyap.tasks.rendezvous import Rendezvous

    return Rendezvous(graph="path", horizon=6)


@pytest.fixture(scope="session")
def games():
    """Rendezvous on every kind of graph, with every dynamics, by name."""
    from marlyap.dynamics import DoubleIntegrator, SingleIntegrator, Unicycle
    from marlyap.tasks.rendezvous import Rendezvous

    return {
        "complete": Rendezvous(),
        "path": Rendezvous(agents=5, graph="path", leaders=(0, 3)),
        "ring": Rendezvous(agents=4, graph="ring", leaders=(2,)),
        "star": Rendezvous(agents=4, graph="star", size=2.5, dynamics=DoubleIntegrator()),
        "disk": Rendezvous(agents=4, graph="disk:0.9", headings=True),
        "edges": Rendezvous(
            agents=4, graph="0-2,2-1,2-3", dynamics=SingleIntegrator(limits=(2.0, 0.5))
        ),
        "rk4": Rendezvous(agents=2, headings=True, dynamics=Unicycle((2.0, 3.0), "rk4")),
        "alone": Rendezvous(agents=1),
    }


@pytest.fixture(scope="session")
def shape():
    """What an algorithm is told of a game; no two sizes are equal."""
    from marlyap.nets import Shape

    return Shape(agents=3, obs=5, features=6, errors=4, du=2)


@pytest.fixture(scope="session")
def batch(shape):
    """16 transitions in which every number is random and independent of the others."""
    from marlyap.types import Transition

    rng = np.random.default_rng(1)
    n = shape.agents
    draw = lambda *size: jnp.asarray(rng.standard_normal((16, *size)), jnp.float32)
    act = jnp.asarray(rng.uniform(-0.95, 0.95, (16, n, shape.du)), jnp.float32)
    return jax.vmap(lambda **k: Transition(**k))(
        obs=draw(n, shape.obs),
        features=draw(n, shape.features),
        action=act,
        log_prob=draw(n) - 1.0,
        reward=draw(n),
        cost=jnp.abs(draw(n)),
        next_obs=draw(n, shape.obs),
        next_features=draw(n, shape.features),
        discount=jnp.where(jnp.arange(16) % 4 == 3, 0.0, 0.95**2).astype(jnp.float32),
        cost_to_go=3 * jnp.abs(draw(n)),
        cost_ahead=jnp.abs(draw(n)),
    )


@pytest.fixture(scope="session")
def masac():
    """MASAC with tiny nets and a learnt constraint."""
    from marlyap.algorithms.masac import MASAC
    from marlyap.constraints.lyapunov import Lyapunov

    return MASAC(actor_width=8, critic_width=8, batch=16, constraint=Lyapunov(horizon=3))


@pytest.fixture(scope="session")
def learner(masac, shape):
    """Its learner in mid-training: targets lag, temperature and norms have moved."""
    import equinox as eqx

    return shaken(eqx.filter_jit(masac.init)(shape, jax.random.key(0)))
