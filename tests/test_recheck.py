"""The independent checker agrees with what is true and rejects what was altered."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import marlyap.recheck.checker

import marlyap.threefry
from marlyap import store
from marlyap.certificate import start_of
from marlyap.certificates.basin import Basin
from marlyap.certificates.composition import Composition
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness, moved
from marlyap.certificates.theorem1 import Theorem1
from marlyap.certify import certify, save
from marlyap.dynamics import DoubleIntegrator, LateUnicycle, SingleIntegrator, Unicycle
from marlyap.errors import UserError
from marlyap.identity import named_arrays, plain
from marlyap.lyapunov_function import Norm, Quadratic
from marlyap.nets import Actors, Greedy, NormNet, Shape
from marlyap.perturb import Perturbed, traced
from marlyap.recheck import Rejected, recheck
from marlyap.recheck.bounds import lower, order
from marlyap.recheck.world import World
from marlyap.rollout import Decentralised, rollout
from marlyap.statistics import lower_bound, quantile_upper_bound
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.threefry import fold, normal, uniform


N = 400
TABLE = {
    "reach": Reach(rollouts=N, share=0.9),
    "reach-and-stay": ReachAndStay(rollouts=N, share=0.9, stay=20),
    "decrease": Decrease(rollouts=N, share=0.9),
    "contraction": Contraction(rollouts=N, calibration=N, share=0.9),
    "basin": Basin(rollouts=N, calibration=N, share=0.9, stay=20),
    "quantiles": Quantiles(rollouts=N),
    "robustness": Robustness(
        rollouts=300, share=0.8, gains=(0.75,), noises=(0.1,), delays=(1,), drops=(0.2,)
    ),
    "composition": Composition(rollouts=N, calibration=100, share=0.9, stay=0),
    "theorem1": Theorem1(rollouts=N, share=0.9, noise=0.02),
}
GAME = Rendezvous(agents=2, leaders=(0, 1), dynamics=SingleIntegrator(limits=(2.0, 2.0)))


def shape(game):
    def seen():
        state = game.reset(jax.random.key(0))
        return game.observations(state), game.features(state), game.errors(state)

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
    assert len(found["not_rechecked"]) == 1 and "l_L" in found["not_rechecked"][0]
    assert len(found["rechecked"]["robustness"]["curve"]) == 6
    for name in ("reach", "theorem1", "composition"):
        said, own = result["verdicts"][name], found["rechecked"][name]
        assert own["trials"] == said["trials"] > N / 4 and said["successes"] > 0
        assert abs(own["successes"] - said["successes"]) <= own["border"]
        assert name == "composition" or own["border"] < 5  # its M is exact on this game


def set_bound(meta, arrays):
    meta["verdicts"]["reach"]["bound"] += 1e-4


def set_successes(meta, arrays):
    meta["verdicts"]["decrease"]["successes"] -= 40


def set_beta(meta, arrays):
    meta["verdicts"]["contraction"]["figures"]["beta"] = 0.9999


def set_quantile(meta, arrays):
    meta["verdicts"]["quantiles"]["figures"]["bounds"]["final_distance"] += 0.01


def set_seed(meta, arrays):
    meta["seed"] += 1


def set_noisy_point(meta, arrays):
    point = meta["verdicts"]["robustness"]["figures"]["curve"][1]
    assert point["change"] == {"noise": 0.1}
    point["change"]["noise"] = 1.0


def set_gain(meta, arrays):
    meta["verdicts"]["composition"]["figures"]["M"][0][0] *= 0.5


def set_delta(meta, arrays):
    meta["verdicts"]["composition"]["figures"]["delta"][1] += 0.01


def set_moved(meta, arrays):
    meta["certificates"]["theorem1"]["noise"] = 1.0


def set_weight(meta, arrays):
    arrays["controller/policy.pi.net.layers.0.weight"][0, 0, 0] += 1e-3


def set_confidence(meta, arrays):
    meta["confidence"] = 0.9999


def set_level(meta, arrays):
    meta["verdicts"]["basin"]["figures"]["level"] *= 0.5


def set_holds(meta, arrays):
    """The point under which it failed is said to hold, and so is the rest."""
    for verdict in meta["verdicts"].values():
        verdict["holds"] = True
    meta["holds"] = True


def set_no_curve(meta, arrays):
    meta["verdicts"]["robustness"]["figures"]["curve"] = []


def set_total(meta, arrays):
    meta["verdicts"]["robustness"]["bound"] = 0.99


def set_quantile_count(meta, arrays):
    meta["verdicts"]["quantiles"]["trials"] += 1


def set_share(meta, arrays):
    meta["verdicts"]["reach"]["figures"]["share_asked"] = 0.999


def set_share_asked(meta, arrays):
    meta["certificates"]["theorem1"]["share"] = 0.0


def set_stay(meta, arrays):
    del meta["certificates"]["reach-and-stay"]["stay"]


def set_floor(meta, arrays):
    meta["certificates"]["contraction"]["c_min"] = 1e9


def set_decrease(meta, arrays):
    meta["certificates"]["decrease"]["beta"] = -1e9


def set_team(meta, arrays):
    meta["game"]["leaders"] = [0]


def set_size(meta, arrays):
    meta["game"]["size"] = meta["controller"]["game"]["size"] = 0.5


def set_policy(meta, arrays):
    meta["controller"]["policy"]["pi"]["shared"] = True


def set_mass(meta, arrays):
    meta["verdicts"]["basin"]["figures"]["mass"][0] = 0.9999


def set_too_many(meta, arrays):
    verdict = meta["verdicts"]["reach"]
    verdict["successes"] = verdict["trials"] + 1


def set_checkpoints(meta, arrays):
    meta["checkpoints"] = 0.002


def set_unsampled(meta, arrays):
    meta["verdicts"]["reach"]["confidence"] = None


def set_evidence(meta, arrays):
    meta["verdicts"]["reach"]["evidence"] = "proved"


def set_theorem(meta, arrays):
    meta["verdicts"]["theorem1"]["evidence"] = "statistical"


def set_negative_gain(meta, arrays):
    meta["verdicts"]["composition"]["figures"]["M"][0][1] = -0.9


def set_kind(meta, arrays):
    meta["certificates"]["reach-and-stay"]["kind"] = "Reach"


def set_name(meta, arrays):
    for part in ("verdicts", "certificates"):
        meta[part] = {f"{k}\n\x1b[2J": v for k, v in meta[part].items()}


def set_rollouts(meta, arrays):
    meta["certificates"]["reach"]["rollouts"] = 10**13


def set_delay(meta, arrays):
    point = meta["verdicts"]["robustness"]["figures"]["curve"][2]
    meta["certificates"]["robustness"]["delays"] = [10**13]
    assert point["change"] == {"delay": 1}
    point["change"]["delay"] = 10**13


FORGERIES = [value for name, value in list(globals().items()) if name.startswith("set_")]


@pytest.mark.parametrize("change", FORGERIES, ids=lambda change: change.__name__)
def test_it_rejects(bundle, tmp_path, change):
    with pytest.raises(Rejected) as caught:
        recheck(altered(bundle[0], tmp_path / "altered", change))
    assert "\n" not in str(caught.value) and str(caught.value).startswith(("certificate: ", "/"))


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
        if name.startswith("controller/"):
            with pytest.raises(UserError):
                recheck(target)


@pytest.mark.parametrize(
    "dynamics, kind, change",
    [
        (Unicycle(), "norm", {}),
        (DoubleIntegrator(), "quadratic", {"noise": 0.3, "gain": 0.5, "spread": 1.5}),
        (SingleIntegrator(), "norm", {"drop": 0.3, "delay": 2}),
        (LateUnicycle(), "norm", {"noise": 0.2, "gain": 1.5, "delay": 1}),
        (Unicycle(), "norm", {"noise": 0.1, "cut": ((0, 1),), "drop": 0.5}),
    ],
)
def test_its_world_is_the_same(dynamics, kind, change):
    """Its own starts, disturbances, integrator, networks and V against the game's."""
    nominal = Rendezvous(agents=3, graph="path", dynamics=dynamics, headings=True)
    game = traced(Perturbed(inner=nominal, **change)) if change else nominal
    controller = Decentralised(Greedy(Actors(shape(nominal), 8, key=jax.random.key(2))), nominal)
    errors = shape(nominal).errors
    net = NormNet(shape(nominal), key=jax.random.key(3))
    V = Norm(net) if kind == "norm" else Quadratic(jnp.eye(errors) + 0.1)
    start = start_of(game, 7, "certify", 2)
    driver = moved(controller, game) if change else controller
    seen = eqx.filter_jit(rollout)(game, driver, start, jax.random.key(5), 15)
    arrays = {f"controller/{k}": v for k, v in named_arrays(controller).items()}
    arrays |= {f"V/{k}": v for k, v in named_arrays(V).items()}
    meta = {"game": plain(nominal), "controller": plain(controller), "V": plain(V), "seed": 7}
    sim = World(meta, arrays)
    found = sim.roll(3, 15, change)
    assert np.allclose(found["x"][2], seen.state.x, atol=1e-4)
    if not change:
        values = eqx.filter_jit(V.along)(game, seen, 16)
        assert np.allclose(sim.values(found, 16)[2], values, rtol=1e-3, atol=1e-4)


def test_its_random_numbers_are_the_seeds_own():
    key = jax.random.fold_in(jax.random.key(2**31 - 1), 5)
    own = fold((np.zeros(1, np.uint32), np.array([2**31 - 1], np.uint32)), 5)
    assert np.array_equal(np.stack(own, axis=1)[0], jax.random.key_data(key))
    assert np.array_equal(uniform(own, 50, 7)[0], jax.random.uniform(key, (50, 7)))
    drawn = np.asarray(jax.random.normal(key, (100_000,)))
    assert np.allclose(normal(own, 100_000)[0], drawn, atol=1e-3) and np.abs(drawn).max() > 4


@pytest.mark.parametrize("k, n", [(0, 20), (7, 20), (20, 20), (9950, 10_000)])
def test_its_bounds_are_the_exact_ones(k, n):
    assert lower(k, n, 1e-3) == pytest.approx(float(lower_bound(k, n, 0.999)), abs=1e-9)


def test_it_is_short_enough_to_be_read():
    """Fewer than 300 lines to judge, and its world and its random numbers beside it."""
    for module, most in (
        (marlyap.recheck.checker, 300),
        (marlyap.recheck.world, 200),
        (marlyap.threefry, 60),
    ):
        assert 30 < len(Path(module.__file__).read_text().splitlines()) < most


def test_its_quantiles_are_the_exact_ones():
    sample = np.random.default_rng(0).normal(size=500)
    assert order(sample, 0.95, 0.01) == quantile_upper_bound(sample, 0.95, 0.99)
    assert order(sample[:20], 0.95, 0.01) == np.inf
