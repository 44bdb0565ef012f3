"""The independent checker agrees with what is true and rejects what was altered."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap import store
from marlyap.certificates.basin import Basin
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certify import certify, save
from marlyap.dynamics import DoubleIntegrator, SingleIntegrator, Unicycle
from marlyap.errors import UserError
from marlyap.identity import named_arrays, plain
from marlyap.lyapunov_function import Norm, Quadratic
from marlyap.nets import Actors, Greedy, NormNet, Shape
from marlyap.recheck import Rejected, Simulator, lower, order, recheck
from marlyap.rollout import Decentralised, rollout
from marlyap.statistics import lower_bound, quantile_upper_bound
from marlyap.tasks.rendezvous import Rendezvous


N = 400
TABLE = {
    "reach": Reach(rollouts=N, share=0.9),
    "reach-and-stay": ReachAndStay(rollouts=N, share=0.9, stay=20),
    "decrease": Decrease(rollouts=N, share=0.9),
    "contraction": Contraction(rollouts=N, calibration=N, share=0.9),
    "basin": Basin(rollouts=N, calibration=N, share=0.9, stay=20),
    "quantiles": Quantiles(rollouts=N),
    "robustness": Robustness(
        rollouts=300, share=0.8, gains=(0.75,), noises=(0.1,), delays=(1,), drops=(), remove=False
    ),
}
GAME = Rendezvous(agents=2, leaders=(0, 1), dynamics=SingleIntegrator(limits=(2.0, 2.0)))


def shape(game):
    def seen():
        state = game.reset(jax.random.key(0))
        return game.observe(state), game.features(state), game.errors(state)

    obs, features, errors = (x.shape[1] for x in jax.eval_shape(seen))
    return Shape(game.agents, obs, features, errors, game.dynamics.du)


def driver(game, gain=1.0):
    """A network that computes tanh(gain * (goal - p)) exactly: relu(x) - relu(-x) = x."""
    actors = Actors(shape(game), 16, key=jax.random.key(0))
    first, second, last = (jnp.zeros_like(l.weight) for l in actors.net.layers)
    for axis, at in enumerate((1, 2)):  # after the leader's flag
        for row, sign in ((2 * axis, 1.0), (2 * axis + 1, -1.0)):
            first = first.at[:, row, at].set(sign)
            second = second.at[:, row, row].set(1.0)
            last = last.at[:, axis, row].set(sign * gain)
    weights = lambda a: [l.weight for l in a.net.layers] + [l.bias for l in a.net.layers]
    biases = [jnp.zeros_like(l.bias) for l in actors.net.layers]
    actors = eqx.tree_at(weights, actors, [first, second, last, *biases])
    return Decentralised(Greedy(actors), game)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    path = tmp_path_factory.mktemp("certificate") / "c"
    controller = driver(GAME)
    result = certify(GAME, controller, TABLE, seed=1, confidence=0.99)
    save(path, result, GAME, controller)
    return path, result


def altered(path, to, change):
    arrays, meta = store.read(path, "certificate")
    meta, arrays = json.loads(json.dumps(meta)), {k: np.array(v) for k, v in arrays.items()}
    change(meta, arrays)
    store.write(to, "certificate", arrays, meta)
    return to


def test_it_agrees(bundle):
    path, result = bundle
    found = recheck(path)
    assert result["verdicts"]["reach"]["holds"] and result["verdicts"]["basin"]["holds"]
    assert set(found["rechecked"]) == set(TABLE)
    assert found["not_rechecked"] == ["robustness: action noise 0.1"]
    reach = found["rechecked"]["reach"]
    assert reach["successes"] == result["verdicts"]["reach"]["successes"]


def set_bound(meta, arrays):
    meta["verdicts"]["reach"]["bound"] += 1e-4


def set_successes(meta, arrays):
    meta["verdicts"]["decrease"]["successes"] -= 40


def set_beta(meta, arrays):
    meta["verdicts"]["contraction"]["figures"]["beta"] = 0.9999


def set_quantile(meta, arrays):
    meta["verdicts"]["quantiles"]["figures"]["bounds"]["final_distance"] += 0.01


def set_start(meta, arrays):
    arrays["starts/x"][0, 0, 0] += 1e-3


def set_weight(meta, arrays):
    arrays["controller/policy.pi.net.layers.0.weight"][0, 0, 0] += 1e-3


def set_confidence(meta, arrays):
    meta["confidence"] = 0.9999


def set_level(meta, arrays):
    meta["verdicts"]["basin"]["figures"]["level"] *= 0.5


@pytest.mark.parametrize(
    "change",
    [
        set_bound,
        set_successes,
        set_beta,
        set_quantile,
        set_start,
        set_weight,
        set_confidence,
        set_level,
    ],
)
def test_it_rejects(bundle, tmp_path, change):
    with pytest.raises(Rejected, match="as the file says|level set"):
        recheck(altered(bundle[0], tmp_path / "altered", change))


def test_a_truncated_file_is_one_sentence(bundle, tmp_path):
    target = altered(bundle[0], tmp_path / "cut", lambda meta, arrays: None)
    payload = target / "arrays.safetensors"
    payload.write_bytes(payload.read_bytes()[:-100])
    with pytest.raises(UserError, match="arrays.safetensors"):
        recheck(target)


def spots(value, path=()):
    """Every place in nested JSON."""
    yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield from spots(inner, (*path, key))


ODD = [None, True, -1, 0, 1e308, "", "x", [], {}, [[]], {"kind": "Unicycle"}]


@pytest.mark.parametrize("start", range(1, 4))
def test_any_odd_value_anywhere_is_rejected_or_harmless(bundle, tmp_path, start):
    """Eight places spread over the file, an odd value at each; nothing else may come of it."""
    count = len([*spots(store.read(bundle[0], "certificate")[1])])
    for place in range(start, count, count // 8):

        def change(meta, arrays, place=place):
            *path, last = [*spots(meta)][place]
            for key in path:
                meta = meta[key]
            meta[last] = ODD[place % len(ODD)]

        target = altered(bundle[0], tmp_path / str(place), change)
        try:
            recheck(target)
        except UserError as error:
            assert "\n" not in str(error)


def test_a_certificate_without_one_of_its_arrays_is_rejected(bundle, tmp_path):
    arrays, _ = store.read(bundle[0], "certificate")
    for number, name in enumerate(arrays):
        target = altered(bundle[0], tmp_path / str(number), lambda _, a, name=name: a.pop(name))
        if name.startswith(("starts/", "controller/", "graph/")):
            with pytest.raises(UserError):
                recheck(target)


@pytest.mark.parametrize(
    "dynamics, kind",
    [(Unicycle(), "norm"), (DoubleIntegrator(), "quadratic"), (SingleIntegrator(), "norm")],
)
def test_its_world_is_the_same(dynamics, kind):
    """Its own integrator, observations, networks and V against the game's, step by step."""
    game = Rendezvous(agents=3, graph="path", dynamics=dynamics, headings=True)
    controller = Decentralised(Greedy(Actors(shape(game), 8, key=jax.random.key(2))), game)
    errors = shape(game).errors
    net = NormNet(shape(game), key=jax.random.key(3))
    V = Norm(net) if kind == "norm" else Quadratic(jnp.eye(errors) + 0.1)
    start = eqx.filter_jit(game.reset)(jax.random.key(4))
    seen = eqx.filter_jit(rollout)(game, controller, start, jax.random.key(5), 15)
    values = eqx.filter_jit(V.along)(game, seen, 16)
    arrays = {f"controller/{k}": v for k, v in named_arrays(controller).items()}
    arrays |= {f"V/{k}": v for k, v in named_arrays(V).items()}
    arrays |= {"graph/slots": game.slots, "graph/linked": game.adjacency, "graph/leads": game.leads}
    arrays |= {"starts/x": np.asarray(start.x)[None], "starts/goal": np.asarray(start.goal)[None]}
    meta = {"game": plain(game), "controller": plain(controller), "V": plain(V)}
    sim = Simulator(meta, arrays)
    found = sim.roll(1, 15, {})
    assert np.allclose(found["x"][0], seen.state.x, atol=1e-4)
    assert np.allclose(sim.values(found, 16)[0], values, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("k, n", [(0, 20), (7, 20), (20, 20), (9950, 10_000)])
def test_its_bounds_are_the_exact_ones(k, n):
    assert lower(k, n, 1e-3) == pytest.approx(float(lower_bound(k, n, 0.999)), abs=1e-9)


def test_its_quantiles_are_the_exact_ones():
    sample = np.random.default_rng(0).normal(size=500)
    assert order(sample, 0.95, 0.01) == quantile_upper_bound(sample, 0.95, 0.99)
    assert order(sample[:20], 0.95, 0.01) == np.inf
