"""Strict settings, a cache of compiled code, and what many tests share.

Nothing of marlyap may be imported at the top of this file: pytest loads it before jaxtyping starts
to check the package, and what is imported by then stays unchecked (test_floors.py notices).
"""

import gc
import itertools
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from long import LONG


jax.config.update("jax_numpy_rank_promotion", "raise")
os.environ["MARLYAP_PROGRAMS"] = ""  # a test may change the code that was traced

# XLA's newer code generator for fused loops takes a third of the time to compile, and tests mostly
# compile. XLA reads its flags once, when the first program is compiled; a child process inherits
# them, so that both find the same code in the cache. An XLA that lacks a flag aborts, so the flag
# is left out for versions of JAX that came later.
PLAIN = "--xla_cpu_use_fusion_emitters=false"
if PLAIN not in os.environ.get("XLA_FLAGS", "") and jax.__version_info__ < (0, 11):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {PLAIN}".strip()

TESTS = itertools.count(1)
MAPS = 25_000  # in use when a module ends; one module adds up to 10,000


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


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what is long as slow; an entry that names no test of a file that was read is a fault."""
    read = {Path(item.path).name for item in items}
    wanted = {(file, name) for file, names in LONG.items() for name in names}
    for item in items:
        own = Path(item.path).name, item.name
        if own in wanted:
            item.add_marker(pytest.mark.slow)
            wanted.discard(own)
    if read >= {*LONG}:
        assert not wanted, f"tests/long.py names what is not there: {sorted(wanted)}"


@pytest.fixture(autouse=True, scope="session")
def single_precision():
    """The package runs in float32; a test that needs more says `with jax.enable_x64(True)`."""
    assert not jax.config.jax_enable_x64


def make_room(most):
    """Forget compiled programs where more than `most` memory maps are in use.

    Each takes ten, and Linux allows 65,530. XLA does not survive the failure of the next one; a
    whole suite in two processes comes that far.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > most:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    yield
    make_room(MAPS)


@pytest.fixture(autouse=True)
def room_within_a_module():
    yield
    if next(TESTS) % 10 == 0:
        make_room(MAPS + 15_000)


def optimise(fully):
    """Whether XLA optimises what this process and its children compile from now on."""
    jax.config.update("jax_disable_most_optimizations", not fully)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not fully)
    jax.clear_caches()  # or what is compiled already would be used as it is


@pytest.fixture(autouse=True, scope="session")
def quick_compilation():
    """Half the time to compile, twice the time to run: most tests mostly compile."""
    optimise(fully=False)


@pytest.fixture(scope="module")
def full_compilation(quick_compilation):
    """As users compile: for modules that pin digits, or that run for longer than they compile."""
    optimise(fully=True)
    yield
    optimise(fully=False)


def put_anywhere(data, value, tree):
    """Write `value` over one place in nested JSON, which Hypothesis's `data` draws."""
    from hypothesis import strategies as st

    while True:
        key = data.draw(st.sampled_from([*tree] if isinstance(tree, dict) else range(len(tree))))
        if not (isinstance(tree[key], dict | list) and tree[key] and data.draw(st.booleans())):
            tree[key] = value
            return
        tree = tree[key]


def filled(make, *args, seed=0):
    """What `make(*args)` returns, every float random: nothing is equal by birth or compiled."""
    import equinox as eqx

    rng = np.random.default_rng(seed)

    def fill(leaf):
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            return leaf
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(np.zeros(leaf.shape, leaf.dtype))
        scale = max(leaf.shape[-1:], default=1) ** -0.5 if leaf.ndim > 1 else 0.5
        return jnp.asarray(np.asarray(rng.standard_normal(leaf.shape) * scale, leaf.dtype))

    return jax.tree.map(fill, eqx.filter_eval_shape(make, *args))


def shrunk(algorithm, **sizes):
    """The algorithm with those of these fields that it has, or that the one it wraps has."""
    import dataclasses

    if hasattr(algorithm, "sac"):
        return dataclasses.replace(algorithm, sac=shrunk(algorithm.sac, **sizes))
    return dataclasses.replace(
        algorithm, **{field: n for field, n in sizes.items() if hasattr(algorithm, field)}
    )


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
def shape():
    """What an algorithm is told of a game; no two sizes are equal."""
    from marlyap.nets.nets import Shape

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
        noise=draw(n, 2, shape.du),
    )


@pytest.fixture(scope="session")
def masac():
    """MASAC with tiny nets and a learnt constraint."""
    from marlyap.learning.algorithms.masac import MASAC
    from marlyap.learning.constraints.lyapunov import Lyapunov

    constraint = Lyapunov(horizon=3, weight=None)
    return MASAC(
        actor_width=8,
        critic_width=8,
        batch=16,
        normalise=True,
        heads="team",
        constraint=constraint,
    )


def level(critic, features, action):
    """The same twins, one of them moved so that each is the smaller for half of a batch."""
    import equinox as eqx

    value = jax.jit(jax.vmap(lambda f, a: critic(f, a)))(features, action)
    gap = jnp.median(value[:, 0] - value[:, 1], axis=0)
    bias = lambda c: c.nets.layers[-1].bias
    return eqx.tree_at(bias, critic, bias(critic).at[0].add(-gap))


@pytest.fixture(scope="session")
def learner(masac, shape, batch):
    """Its learner in mid-training: targets lag, norms and temperature have moved; Adam is fresh."""
    import equinox as eqx

    from marlyap.learning.optimiser import TrainState

    l = filled(masac.init, shape, jax.random.key(0))
    number = lambda x: jnp.asarray(x, jnp.float32)
    fresh = lambda learnt: TrainState.of(learnt.value)
    L = l.L
    L = eqx.tree_at(
        lambda L: (L.net, L.log_weight, L.gradient, L.scale),
        L,
        (fresh(L.net), TrainState.of(number(np.log(0.3))), number(0.8), number(1.7)),
    )
    l = eqx.tree_at(lambda l: l.Q_bar, l, level(l.Q_bar, batch.next_features, batch.action))
    return eqx.tree_at(
        lambda l: (l.pi, l.Q, l.log_alpha, l.L),
        l,
        (
            fresh(l.pi),
            TrainState.of(level(l.Q.value, batch.features, batch.action)),
            TrainState.of(number(-1.2)),
            L,
        ),
    )


def untrained(directory, game, algorithm=None, names=None):
    """A run of this game whose policy is random: as good as a trained one where bits count."""
    from marlyap.learning.algorithms.masac import MASAC
    from marlyap.learning.schedule import Schedule
    from marlyap.learning.source import shape as shape_of
    from marlyap.learning.trainer import Trainer
    from marlyap.runs.run import Run, flatten
    from marlyap.storage import store

    rule = MASAC(actor_width=16, critic_width=8, batch=16) if algorithm is None else algorithm
    run = Run.create(directory, Trainer(game, rule, Schedule()), 0, names or {"task": "test"})
    networks = filled(rule.init, shape_of(game), jax.random.key(0))
    deployed = rule.policy(networks), rule.lyapunov(networks)
    store.write(run.directory / "policy", "policy", flatten(deployed), {})
    return run


@pytest.fixture(scope="session")
def small_run(tmp_path_factory):
    """Three robots whose horizon is ten steps, with a random policy."""
    from marlyap.tasks.rendezvous import Rendezvous

    return untrained(tmp_path_factory.mktemp("small") / "seed0", Rendezvous(horizon=10))


@pytest.fixture(scope="session")
def small_bundle(small_run, tmp_path_factory):
    """The bundle of that run, with the runtimes that can be written here."""
    from importlib.util import find_spec

    from marlyap.deploy.bundle import write

    runtimes = [name for name in ("numpy", "onnx", "c") if name != "onnx" or find_spec("onnx")]
    out = tmp_path_factory.mktemp("small") / "bundle"
    write(small_run, out, runtimes, starts=0)
    return out
