"""The independent checker agrees with what is true and rejects what was altered."""

import ast
import copy
import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import marlyap.recheck
from marlyap import graph as graphs
from marlyap.certificates.basin import Basin
from marlyap.certificates.certificate import Found, start_of, worst_of
from marlyap.certificates.certify import certify, save
from marlyap.certificates.composition import Composition
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.linearisation import Linearisation
from marlyap.certificates.loop import seen_through
from marlyap.certificates.lyapunov import Norm, Quadratic
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certificates.safety import Apart, Safe
from marlyap.certificates.theorem1 import Theorem1
from marlyap.cli import main
from marlyap.controllers import CartFeedback
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, LateUnicycle, SingleIntegrator, Unicycle
from marlyap.games.perturbed import Perturbed, traced
from marlyap.nets.nets import Actors, Greedy, NormNet, Shape
from marlyap.recheck import Rejected, reader, recheck
from marlyap.recheck.bounds import lower, needed, order
from marlyap.recheck.checks import swept
from marlyap.recheck.world import World, adjacency, hops, places, unknown
from marlyap.simulation.rollout import Decentralised, rollout
from marlyap.statistics import lower_bound, quantile_upper_bound, trials_needed
from marlyap.storage import store
from marlyap.storage.hashing import as_json, named_arrays, policy_hash, without_arrays, words
from marlyap.tasks import CartPoles, Rendezvous
from marlyap.threefry import fold, normal, uniform, uniform64


N = 300
TABLE = {
    "reach": Reach(rollouts=N, share=0.9),
    "reach-and-stay": ReachAndStay(rollouts=N, share=0.9, stay=10),
    "decrease": Decrease(rollouts=N, share=0.9),
    "contraction": Contraction(rollouts=N, calibration=N, T=12, share=0.9),
    "basin": Basin(rollouts=N, calibration=N, share=0.9, stay=10),
    "quantiles": Quantiles(rollouts=N),
    "robustness": Robustness(
        rollouts=150, share=0.8, gains=(0.75,), noises=(0.1,), delays=(1,), drops=(0.2,)
    ),
    "composition": Composition(rollouts=N, calibration=100, share=0.9, stay=0),
    "theorem1": Theorem1(rollouts=N, share=0.9, noise=0.02),
    "apart": Apart(rollouts=N, calibration=N, share=0.9, stay=10, least=0.0),
    "linearisation": Linearisation(scenes=3),
}
GAME = Rendezvous(agents=2, leaders=(0, 1), horizon=24, dynamics=SingleIntegrator((2.0, 2.0)))
FAR = 8.0  # more than any goal is away (m)


def shape(game):
    def seen():
        state = game.reset(jax.random.key(0))
        return game.observations(state), game.features(state), game.errors(state)

    obs, features, errors = (x.shape[1] for x in jax.eval_shape(seen))
    return Shape(game.agents, obs, features, errors, game.dynamics.du)


def driver(game, gain=1.0):
    """A network that computes tanh(gain * (goal - p)), since relu(x + FAR) - FAR = x."""
    actors = Actors(shape(game), 8, key=jax.random.key(0))
    first, second, last = (jnp.zeros_like(l.weight) for l in actors.net.layers)
    near, _, end = (jnp.zeros_like(l.bias) for l in actors.net.layers)
    for axis, at in enumerate((1, 2)):  # after the leader's flag
        first, second = first.at[:, axis, at].set(1.0), second.at[:, axis, axis].set(1.0)
        last, near = last.at[:, axis, axis].set(gain), near.at[:, axis].set(FAR)
        end = end.at[:, axis].set(-gain * FAR)
    weights = lambda a: [l.weight for l in a.net.layers] + [l.bias for l in a.net.layers]
    actors = eqx.tree_at(weights, actors, [first, second, last, near, 0 * near, end])
    return Decentralised(Greedy(actors), game)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, quick_compilation):
    path = tmp_path_factory.mktemp("certificate") / "c"
    controller = driver(GAME)
    result = certify(GAME, controller, TABLE, seed=1, confidence=0.99)
    save(path, result, GAME, controller)
    return path, result


def altered(path, to, change):
    """A copy in which `change` edited meta and arrays, with all hashes made anew."""
    arrays, meta = store.read(path, "certificate")
    meta, arrays = json.loads(json.dumps(meta)), {k: np.array(v) for k, v in arrays.items()}
    change(meta, arrays)
    store.write(to, "certificate", arrays, meta)
    return to


def put(*edits):
    """A change that sets the value at each dotted place, or what a function makes of it."""

    def change(meta, arrays):
        for place, value in edits:
            *path, last = place.split("/")
            node = meta
            for key in path:
                node = node[int(key) if isinstance(node, list) else key]
            last = int(last) if isinstance(node, list) else last
            node[last] = value(node[last]) if callable(value) else value

    return change


def test_it_agrees(bundle):
    path, result = bundle
    heard = {}
    found = recheck(path, heard.__setitem__)
    assert result["verdicts"]["reach"]["holds"] and result["verdicts"]["basin"]["holds"]
    assert {*found["rechecked"]} | {*found["not_rechecked"]} == {*TABLE}
    assert heard == {n: v for n, v in store.read(path, "certificate")[1]["verdicts"].items()
                     if n in found["rechecked"]}  # fmt: skip
    assert [*found["not_rechecked"]] == ["theorem1"] and "l_L" in found["not_rechecked"]["theorem1"]
    assert not found["agrees"] and found["holds"] is None
    assert len(found["rechecked"]["robustness"]["curve"]) == 6
    for name in ("reach", "contraction", "composition"):
        said, own = result["verdicts"][name], found["rechecked"][name]
        assert own["trials"] == said["trials"] > N / 4 and said["successes"] > 0
        assert abs(own["successes"] - said["successes"]) <= own["border"]
        assert name == "composition" or own["border"] < 8  # its M is exact on this game


V, C = "verdicts/", "certificates/"
CURVE = V + "robustness/figures/curve"


def both(name, part, value, figure=None):
    """What was asked, and the figure that repeats it."""
    return (f"{C}{name}/{part}", value), (f"{V}{name}/figures/{figure or part}", value)


def set_weight(meta, arrays):
    """Wherever the policy is told, and its hash made anew."""
    for part in ("controller/", "V/controller."):
        arrays[f"{part}policy.pi.net.layers.0.weight"][0, 0, 1] += 0.5
    own = {k[11:]: v for k, v in arrays.items() if k.startswith("controller/")}
    meta["policy"] = store.hash_arrays(own)


def set_weight_alone(meta, arrays):
    arrays["controller/policy.pi.net.layers.0.weight"][0, 0, 0] += 1e-3


def set_weight_in_V(meta, arrays):
    arrays["V/controller.policy.pi.net.layers.0.weight"][0, 0, 0] += 1e-3


def set_extra_array(meta, arrays):
    arrays["V/more"] = np.zeros(3)


def set_words(meta, arrays):
    """Other words are hashed than the file shows."""
    text = arrays["controller/words"].tobytes().replace(b'"shared": false', b'"shared": true ')
    arrays["controller/words"] = np.frombuffer(text, np.uint8)
    own = {k[11:]: v for k, v in arrays.items() if k.startswith("controller/")}
    meta["policy"] = store.hash_arrays(own)


def set_holds(meta, arrays):
    """The verdict that fails is said to hold, and so is the rest."""
    for verdict in meta["verdicts"].values():
        verdict["holds"] = True
    meta["holds"] = True


def set_confidences(meta, arrays):
    """Everywhere, without the bounds."""
    each = 1 - (1 - 0.9999) / 10
    meta["confidence"], meta["confidence_each"] = 0.9999, each
    for name in meta["verdicts"]:
        meta["verdicts"][name]["confidence"] = meta["certificates"][name]["confidence"] = each


def set_everywhere(key, value):
    """A field of the game, wherever it is told, and the hash of the policy made anew."""

    def change(meta, arrays):
        *path, last = key.split("/")
        for game in (meta["game"], meta["controller"]["game"], meta["V"]["controller"]["game"]):
            for step in path:
                game = game[step]
            game[last] = value
        text = json.dumps(meta["controller"], sort_keys=True).encode()
        for name in ("controller/words",):
            arrays[name] = np.frombuffer(text, np.uint8)
        own = {k[11:]: v for k, v in arrays.items() if k.startswith("controller/")}
        meta["policy"] = store.hash_arrays(own)

    return change


def set_no_verdict(*names):
    """Without these verdicts, as if the rest were all that was asked, and all of it held."""

    def change(meta, arrays):
        for name in names:
            del meta["verdicts"][name], meta["certificates"][name]
        meta["holds"] = True

    return change


def set_extra(name, kind, **fields):
    """One more verdict, of which nothing is true."""

    def change(meta, arrays):
        lie = copy.deepcopy(meta["verdicts"]["reach"]) | {"name": name, "confidence": None}
        meta["verdicts"][name] = lie | fields
        if kind is not None:
            meta["certificates"][name] = {"kind": kind, "confidence": meta["confidence_each"]}

    return change


def renamed(old, new):
    def change(meta, arrays):
        for part in ("verdicts", "certificates"):
            meta[part] = {new if k == old else k: v for k, v in meta[part].items()}
        meta["verdicts"][new]["name"] = new

    return change


PROOF = dict(c=1.0, rho=0.1, inner=0.1, half=[1.0, 1, 1, 1], eta=0.1, decay=0.0, most=9, batch=9)


def set_proof(meta, arrays):
    """A proof that was asked for, in due form."""
    set_extra("proof", "Proof", evidence="proved", claim="proved: from every state")(meta, arrays)
    meta["certificates"]["proof"] |= PROOF | {"resume": None, "show": False}


FORGERIES = {
    "policy": put(("policy", "0" * 64)),
    "weight": set_weight,
    "weight-alone": set_weight_alone,
    "weight-in-V": set_weight_in_V,
    "extra-array": set_extra_array,
    "words": set_words,
    "seed": put(("seed", 2)),
    "no-seed": put(("seed", -1)),
    "confidence": put(("confidence", 0.9999)),
    "confidences": set_confidences,
    "confidence-1": put(("confidence", 1.0)),
    "checkpoints-many": put(("checkpoints", 20)),
    "checkpoints-none": put(("checkpoints", 0)),
    "checkpoints-part": put(("checkpoints", 0.002)),
    "checkpoints-true": put(("checkpoints", True)),
    "schema": put(("schema", 2)),
    "extra-key": put(("audited_by", "TUV")),
    "no-key": lambda meta, arrays: meta.pop("confidence_each"),
    "holds": set_holds,
    "holds-overall": put(("holds", True)),
    "horizon": set_everywhere("horizon", 30),
    "radius": set_everywhere("radius", 0.2),
    "limits": set_everywhere("dynamics/limits", [20.0, 20.0]),
    "size": set_everywhere("size", 0.5),
    "leaders": set_everywhere("leaders", [0]),
    "graph": set_everywhere("graph", "0--1"),
    "agents": set_everywhere("agents", 10**9),
    "game-key": set_everywhere("real_hardware", True),
    "radius-true": set_everywhere("radius", True),
    "game-alone": put(("game/size", 0.5)),
    "shared": put(("controller/policy/pi/shared", True)),
    "own-actors": put(("controller/policy/pi/kind", "Actors (own code)")),
    "own-layer": put(("controller/policy/pi/net/layers/0/kind", "Layer (own code)")),
    "V-ball": put(("V/ball", 0.2)),
    "V-steps": put(("V/T", 5)),
    "V-key": put(("V/lipschitz", 1.0)),
    # Counts, bounds, verdicts.
    "bound": put((V + "reach/bound", lambda old: old + 5e-4)),
    "bound-text": put((V + "reach/bound", "0.99999")),
    "doubled": put((V + "reach/trials", 2 * N), (V + "reach/successes", 2 * N)),
    "rollouts": put((C + "reach/rollouts", 10**9)),
    "rollouts-more": put((C + "reach/rollouts", 10**13)),
    "successes": put((V + "decrease/successes", lambda old: old - 40)),
    "successes-more": put((V + "reach/successes", N + 1)),
    "successes-real": put((V + "reach/successes", float(N))),
    "trials-real": put((V + "reach/trials", float(N))),
    "holds-1": put((V + "reach/holds", 1)),
    "evidence": put((V + "reach/evidence", "proved")),
    "evidence-of-theorem1": put((V + "theorem1/evidence", "statistical")),
    "quantiles-proved": put(
        (V + "quantiles/evidence", "proved"), (V + "quantiles/confidence", None)
    ),
    "unsampled": put((V + "reach/confidence", None)),
    "share": put((V + "reach/figures/share_asked", 0.999)),
    "share-asked": put((C + "reach/share", 0.5)),
    "share-of-theorem1": put((C + "theorem1/share", 0.0)),
    "share-reached": put(*both("theorem1", "share", 0.5, "share_asked")),
    "drawn": put((V + "reach/figures/drawn", 10**9)),
    "extra-figure": put((V + "reach/figures/accidents", 0)),
    "extra-verdict-key": put((V + "reach/signed", "yes")),
    "extra-asked-key": put((C + "reach/hardware", "real")),
    "no-stay": lambda meta, arrays: meta["certificates"]["reach-and-stay"].pop("stay"),
    "stay": put(*both("reach-and-stay", "stay", 4000, "stay_steps")),
    "beta": put((V + "contraction/figures/beta", 0.9999)),
    "floor": put(*both("contraction", "c_min", 1e9)),
    "windows": put((V + "contraction/figures/rollouts_with_a_window", 7)),
    "calibration": put((V + "contraction/figures/calibration", 10**6)),
    "decrease": put((C + "decrease/beta", -1e9)),
    "violating": put((V + "decrease/figures/transitions_violating", 0.9)),
    "entered": put((V + "decrease/figures/entered", 0)),
    "quantile": put((V + "quantiles/figures/bounds/final_distance", lambda old: 0.5 * old)),
    "quantile-more": put((V + "quantiles/figures/bounds/final_distance", lambda old: old + 0.01)),
    "q": put(*both("quantiles", "q", 0.999)),
    "quantile-trials": put((V + "quantiles/trials", N + 1)),
    "settling": put((V + "quantiles/figures/bounds/settling_time", 0.1)),
    "level": put((V + "basin/figures/level", lambda old: 0.5 * old)),
    "mass": put((V + "basin/figures/mass/0", 0.9999)),
    "failures": put((V + "basin/figures/failures_calibrating", 9)),
    "needed": put((V + "basin/figures/needed_inside", 1)),
    "noise": put((CURVE + "/1/change/noise", 1.0)),
    "delay": put((CURVE + "/2/change/delay", 10**13), (C + "robustness/delays/0", 10**13)),
    "curve": put((CURVE, [])),
    "curve-name": put((CURVE + "/1/perturbation", "any disturbance")),
    "curve-key": put((CURVE + "/1/hardware", "real")),
    "without": put((V + "robustness/figures/without", {"drop": "harmless"})),
    "total": put((V + "robustness/bound", 0.99)),
    "gain": put((V + "composition/figures/M/0/0", lambda old: 0.5 * old)),
    "gain-negative": put((V + "composition/figures/M/0/1", -0.9)),
    "delta": put((V + "composition/figures/delta/1", lambda old: old + 0.01)),
    "begin-above": put((V + "composition/figures/begin_above", 0)),
    "moved": put((C + "theorem1/noise", 1.0)),
    "l_L": put((V + "theorem1/figures/l_L", 0.1)),
    "margin": put((V + "theorem1/figures/margin_median", 9.0)),
    # Words.
    "claim": put(
        (V + "reach/claim", "from every start every robot stays within 0.01 m, on real hardware")
    ),
    "claim-percent": put(
        (V + "reach/claim", lambda old: old.replace("at least 9", "at least 99.9"))
    ),
    "claim-of-robustness": put((V + "robustness/claim", lambda old: old.replace("6", "60"))),
    "claim-of-theorem1": put((V + "theorem1/claim", lambda old: old + " and satisfies it")),
    "scope-steps": put((V + "reach/scope/horizon_steps", 4000)),
    "scope-seconds": put((V + "reach/scope/horizon_seconds", 400.0)),
    "scope-starts": put((V + "reach/scope/starts", "any")),
    "scope-disturbance": put((V + "reach/scope/disturbance", "any")),
    "scope-radius": put((V + "reach/scope/radius", 0.01)),
    "scope-key": put((V + "reach/scope/hardware", "real robots")),
    "scope-of-robustness": put((V + "robustness/scope/disturbance", "all at once")),
    "scope-of-basin": put((V + "basin/scope/starts_with", "V <= 1000")),
    # Worst cases.
    "worst-badness": put((V + "reach/worst/badness", 1e-4)),
    "worst-figures": put(
        (V + "reach/worst/badness", 1e-4), (V + "reach/worst/figures/final_distance", 1e-4)
    ),
    "worst-state": put((V + "reach/worst/state/x/0/0", lambda old: old + 0.1)),
    "worst-goal": put((V + "reach/worst/state/scenario/goal/1/0", lambda old: old + 0.1)),
    "worst-episode": put((V + "reach/worst/episode", -1)),
    "worst-seed": put((V + "reach/worst/seed", 2)),
    "worst-purpose": put((V + "reach/worst/purpose", "calibrate")),
    "worst-failed": put((V + "theorem1/worst/failed", False)),
    "worst-none": put((V + "reach/worst", None)),
    "worst-key": put((V + "reach/worst/excuse", "wind")),
    "worst-of-a-point": put((CURVE + "/1/worst/badness", 1e-4)),
    "worst-of-robustness": put((V + "robustness/worst/change", {"gain": 2.0})),
    # Verdicts that were not asked for, or not given.
    "renamed": renamed("reach-and-stay", "guaranteed for ever"),
    "renamed-asked": put((C + "reach-and-stay/kind", "Reach")),
    "unprintable": renamed("reach", "reach\n\x1b[2J"),
    "name": put((V + "reach/name", "guaranteed for ever")),
    "dropped": set_no_verdict("theorem1"),
    "all-dropped": set_no_verdict(*TABLE),
    "no-verdict": lambda meta, arrays: meta["verdicts"].pop("theorem1"),
    "not-asked": lambda meta, arrays: meta["certificates"].pop("theorem1"),
    "extra": set_extra("proof", None, evidence="proved", claim="proved: from every state"),
    "extra-proof": set_extra("proof", "Proof", evidence="proved", claim="proved"),
    "extra-proof-in-due-form": set_proof,
    "extra-closed-form": set_extra("closed-form", "ClosedForm", evidence="proved", claim="proved"),
    "extra-safety-case": set_extra("safety-case", "SafetyCase", claim="certified to SIL 4"),
    "linearisation-radius": put(
        (V + "linearisation/bound", 0.5), (V + "linearisation/figures/spectral_radius", 0.5)
    ),
    "linearisation-claim": put((V + "linearisation/claim", "globally exponentially stable")),
    "linearisation-proved": put((V + "linearisation/evidence", "proved")),
    "linearisation-scope": put((V + "linearisation/scope/starts", "everywhere")),
    "linearisation-margin": put(*both("linearisation", "margin", -0.5)),
    "linearisation-scenes": put(*both("linearisation", "scenes", 10**6)),
    "linearisation-trials": put((V + "linearisation/trials", 10**9)),
    "apart-gap": put((V + "apart/figures/gap", 0.3)),
    "apart-gap-claimed": put(
        (V + "apart/figures/gap", 0.3),
        (V + "apart/claim", lambda old: old.replace("than 0", "than 0.3 m")),
    ),
    "information": put(("information", "each agent acts on nothing")),
    "information-in-scope": put((V + "reach/scope/information", "no communication is needed")),
    "left-out": put(("left_out", {"safe": "it was certified to SIL 4 elsewhere"})),
    "left-out-unknown": put(("left_out", {"safety-case": "certified to SIL 4"})),
    "left-out-and-in": put(("left_out", {"reach": "it was certified elsewhere"})),
    "left-out-V": put(("left_out", {"apart": "V, as before, is 3 on the target set"})),
    "extra-safe": set_extra("safe", "Safe", claim="no two robots ever collide"),
    "extra-safety-case-alone": set_extra("safety-case", None, claim="certified to SIL 4"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_it_rejects(bundle, tmp_path, name):
    with pytest.raises(Rejected) as caught:
        recheck(altered(bundle[0], tmp_path / "altered", FORGERIES[name]))
    assert "\n" not in str(caught.value) and str(caught.value).startswith(("certificate: ", "/"))


def sealed(body):
    """The manifest with its own hash, whatever is in it."""
    seal = store._sha256([json.dumps(body).encode()])
    return json.dumps({**body, "sha256": seal}, indent=1)


def in_bound(token):
    """The bound of reach replaced by other text, behind all hashes."""
    return lambda text, body: text.replace(
        f'"bound": {body["meta"]["verdicts"]["reach"]["bound"]}', token, 1
    )


RAW = {
    "by-hand": lambda text, body: text.replace('"horizon_steps": 24', '"horizon_steps": 4000'),
    "nan": in_bound('"bound": NaN'),
    "infinite": in_bound('"bound": -Infinity'),
    "huge": in_bound('"bound": 1e400'),
    "digits": in_bound('"bound": ' + "9" * 5000),
    "minus-zero": in_bound('"bound": -0'),
    "duplicate": lambda text, body: text.replace('"holds": ', '"holds": true,\n "holds": ', 1),
    "trailing": lambda text, body: text + "{}",
    "comment": lambda text, body: "// sound\n" + text,
    "mark": lambda text, body: "\ufeff" + text,
    "deep": lambda text, body: sealed(body | {"meta": eval_deep(500)}),
    "deeper": lambda text, body: text.replace('"meta": {', '"meta": ' + "[" * 10**5, 1),
    "schema": lambda text, body: sealed(body | {"schema": 2}),
    "schema-real": lambda text, body: sealed(body | {"schema": 1.0}),
    "kind": lambda text, body: sealed(body | {"kind": "policy"}),
    "extra-part": lambda text, body: sealed(body | {"signature": "TUV"}),
    "versions": lambda text, body: sealed(body | {"versions": {"marlyap": ["best"]}}),
    "surrogate": lambda text, body: text.replace('"reach"', '"\\ud800"', 1),
}


def eval_deep(levels):
    value = []
    for _ in range(levels):
        value = [value]
    return value


@pytest.mark.parametrize("name", RAW)
def test_it_rejects_a_manifest_that_is_not_strict(bundle, tmp_path, name):
    target = altered(bundle[0], tmp_path / "c", lambda meta, arrays: None)
    manifest = target / reader.MANIFEST
    body = json.loads(manifest.read_text())
    body.pop("sha256")
    assert sealed(body) + "\n" == manifest.read_text()
    text = RAW[name](manifest.read_text(), body)
    assert text != manifest.read_text()
    manifest.write_text(text)
    with pytest.raises(Rejected, match="^/"):
        recheck(target)


def test_true_restatements_are_accepted(tmp_path, quick_compilation):
    """Fewer rollouts, other levels, another order, more confidence: the same policy, still true."""
    table = {
        "contraction": Contraction(rollouts=200, calibration=250, T=8, share=0.8),
        "reach-and-stay": ReachAndStay(rollouts=250, share=0.9, stay=20),
        "decrease": Decrease(rollouts=200, share=0.5, beta=0.5),
        "reach": Reach(rollouts=150, share=0.8),
    }
    controller = driver(GAME)
    result = certify(GAME, controller, table, seed=1, confidence=0.9999)
    save(tmp_path / "c", result, GAME, controller)

    def reverse(meta, arrays):
        for part in ("verdicts", "certificates"):
            meta[part] = dict(reversed(meta[part].items()))

    for path in (tmp_path / "c", altered(tmp_path / "c", tmp_path / "reversed", reverse)):
        found = recheck(path)
        assert found["agrees"] and {*found["rechecked"]} == {*table} and found["holds"]
    weaker = put(*both("reach", "share", 0.5, "share_asked"))
    assert recheck(altered(tmp_path / "c", tmp_path / "weaker", weaker))["agrees"]


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
    for number, name in enumerate(store.read(bundle[0], "certificate")[0]):
        target = altered(bundle[0], tmp_path / str(number), lambda _, a, name=name: a.pop(name))
        with pytest.raises(Rejected):
            recheck(target)


@pytest.mark.parametrize("dynamics", [Unicycle(), DoubleIntegrator()])
def test_what_a_linearisation_does_not_show_cannot_be_claimed(
    dynamics, tmp_path, quick_compilation
):
    """A unicycle that no feedback moves sideways, and a goal that is no equilibrium."""
    game = Rendezvous(agents=2, horizon=20, dynamics=dynamics, rest_weight=0.5)
    controller = Decentralised(Greedy(Actors(shape(game), 4, key=jax.random.key(2))), game)
    turns = isinstance(dynamics, Unicycle)
    V, table = Quadratic(jnp.eye(4)), {"linearisation": Linearisation(scenes=2)}
    if turns:
        table["contraction"] = Contraction(rollouts=100, calibration=100, T=9, share=0.1)
        table["safe"] = Safe(rollouts=100, share=0.1)
    else:
        V, table["decrease"] = None, Decrease(rollouts=100, share=0.1)
    result = certify(game, controller, table, seed=1, confidence=0.9, V=V)
    save(tmp_path / "c", result, game, controller, V)
    found = recheck(tmp_path / "c")
    assert (
        found["agrees"]
        and not found["holds"]
        and [*result["left_out"]] == ["safe" if turns else "decrease"]
    )
    claim = result["verdicts"]["linearisation"]["claim"]
    assert ("NO: " if turns else "no equilibrium") in claim
    said = "verdicts/linearisation/"
    for number, lie in enumerate(
        (
            put((said + "holds", True), ("holds", True)),
            put((said + "claim", claim.replace("NO: ", "").replace("no ", "an "))),
            put((said + "evidence", "observed" if turns else "proved")),
            put((said + "figures/uncontrollable_eigenvalues", [0.5])),
            put((said + "figures/action_at_goal", 0.0)),
            lambda meta, arrays: meta["left_out"].update(apart="a team of one"),
            lambda meta, arrays: meta["left_out"].update(contraction="V, as before, is 3"),
            put(
                ("left_out/" + ("safe" if turns else "decrease"), lambda old: old + " It is safe.")
            ),
        )
    ):
        with pytest.raises(Rejected):
            recheck(altered(tmp_path / "c", tmp_path / str(number), lie))


# --- Files ---------------------------------------------------------------------------------------


def copied(bundle, to):
    return altered(bundle[0], to, lambda meta, arrays: None)


def test_no_byte_of_either_file_can_be_changed_or_missing(bundle, tmp_path):
    target = copied(bundle, tmp_path / "c")
    for file in target.iterdir():
        whole = file.read_bytes()
        for place in np.linspace(0, len(whole) - 1, 30).astype(int):
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            with pytest.raises(Rejected, match=file.name):
                reader.read(target)
            file.write_bytes(whole[:place])
            with pytest.raises(Rejected, match=file.name):
                reader.read(target)
        file.write_bytes(whole)
    reader.read(target)


def test_a_header_that_says_something_else_is_rejected(bundle, tmp_path):
    """All hashes are right, and the arrays would be read from other places than the header says."""
    target = copied(bundle, tmp_path / "c")
    manifest, payload = target / reader.MANIFEST, target / reader.PAYLOAD
    body, data = json.loads(manifest.read_text()), payload.read_bytes()
    body.pop("sha256")
    for old, new in ((b'"shape":[2', b'"shape":[1'), (b"F32", b"I32"), (b"[0,", b"[8,")):
        other = data.replace(old, new, 1)
        assert other != data
        payload.write_bytes(other)
        body["files"][reader.PAYLOAD]["sha256"] = store._sha256([other])
        manifest.write_text(sealed(body) + "\n")
        with pytest.raises(Rejected, match="describes"):
            reader.read(target)


def test_it_reads_what_the_store_wrote(tmp_path):
    dtypes = {"bool": bool, "f4": "float32", "f8": "float64", "i1": "int8", "u2": "uint16"}
    arrays = {name: np.arange(6).reshape(2, 3).astype(dtype) for name, dtype in dtypes.items()}
    arrays |= {"none": np.zeros((0, 3)), "number": np.array(3.0)}
    store.write(tmp_path / "c", "certificate", arrays, {"a": [1, 2.5, None, "é"]})
    found, meta = reader.read(tmp_path / "c")
    assert meta == {"a": [1, 2.5, None, "é"]} and {*found} == {*arrays}
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and np.array_equal(found[name], array)
    assert reader.policy_hash(arrays) == store.hash_arrays(arrays)


def test_its_hash_is_the_policys(bundle):
    controller = driver(GAME)
    arrays = {k: np.asarray(v) for k, v in named_arrays(controller).items()}
    assert reader.policy_hash(arrays | {"words": words(controller)}) == policy_hash(controller)


def test_links_pipes_and_other_files_are_refused_in_a_sentence(bundle, tmp_path):
    target = copied(bundle, tmp_path / "c")
    payload, away = target / reader.PAYLOAD, tmp_path / "away"
    payload.rename(away)
    payload.symlink_to(away)
    with pytest.raises(Rejected, match="link"):
        recheck(target)
    payload.unlink()
    os.mkfifo(payload)
    with pytest.raises(Rejected, match=reader.PAYLOAD):
        recheck(target)
    payload.unlink()
    with pytest.raises(Rejected, match="missing"):
        recheck(target)
    away.rename(payload)
    (target / "notes.txt").touch()
    with pytest.raises(Rejected, match="notes.txt does not belong to a certificate") as caught:
        recheck(target)
    assert "alien" not in str(caught.value) and "remove" not in str(caught.value)
    for path in (tmp_path / "none", away.with_name("c") / reader.MANIFEST):
        with pytest.raises(Rejected, match="check the path"):
            recheck(path)


@pytest.mark.parametrize("certified", [True, False])
def test_of_a_run_it_says_where_its_certificate_is(tmp_path, certified):
    for name in ("run.json", ".lock", "log.jsonl"):
        (tmp_path / name).touch()
    (tmp_path / "certificate").mkdir() if certified else None
    with pytest.raises(Rejected, match="that is a run; ") as caught:
        recheck(tmp_path)
    text = str(caught.value)
    assert (f"its certificate is {tmp_path / 'certificate'}." in text) == certified
    assert "lock" not in text and "remove" not in text


def test_it_ends_well_only_when_all_was_checked(bundle, tmp_path, capsys):
    assert main(["recheck", str(bundle[0])]) == 1
    out = capsys.readouterr().out
    assert "NOT CHECKED: theorem1: its constant l_L" in out and "not confirmed" in out
    assert f"reach agrees: {bundle[1]['verdicts']['reach']['claim']}: holds." in out
    assert main(["recheck", str(bundle[0]), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["agrees"] is False
    assert main(["recheck", str(altered(bundle[0], tmp_path / "c", FORGERIES["claim"]))]) == 2


# --- Nothing shared with the maker ---------------------------------------------------------------


def test_it_imports_nothing_of_what_makes_certificates():
    folder = Path(marlyap.recheck.__file__).parent
    allowed = {"numpy", "marlyap.errors", "marlyap.threefry"}
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level
                names = [str(node.module)]
            else:
                continue
            for name in names:
                own = f"{name}.".startswith("marlyap.recheck.")
                standard = name.partition(".")[0] in sys.stdlib_module_names
                assert own or standard or name in allowed, (file.name, name)


def test_it_loads_no_jax():
    code = "import sys, marlyap.recheck; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in ran.stdout.split()}
    assert "numpy" in loaded and not loaded & {"jax", "jaxlib", "equinox", "scipy"}
    ours = {name for name in ran.stdout.split() if name.startswith("marlyap.")}
    assert all(
        n.startswith(("marlyap.recheck", "marlyap.errors", "marlyap.threefry")) for n in ours
    )


GRAPHS = ["complete", "path", "ring", "star", "0-1,1-2,2-3,3-4,4-5,1-4", "path/3", "complete/2"]


@pytest.mark.parametrize("graph", [*GRAPHS, "geometric:0.8", "geometric:1.5/2"])
def test_its_graph_is_the_same(graph):
    """geometric graphs share the generator of random numbers with the maker, and nothing else."""
    linked = graphs.adjacency(graph, 6)
    assert np.array_equal(adjacency(graph, 6), linked)
    assert np.array_equal(places(linked, graph), graphs.neighbours(linked, graphs.room(graph)))
    sources = np.isin(np.arange(6), (1, 4))
    assert np.array_equal(hops(linked, sources), graphs.hops(linked, (1, 4)))
    assert np.array_equal(places(adjacency("path", 1), "path"), np.zeros((1, 0)))


@pytest.mark.parametrize(
    "graph, agents", [("path", 4), ("ring", 4), ("0-1,1-2,0-2,2-3", 4), ("path", 1)]
)
def test_it_knows_what_robustness_sweeps(graph, agents):
    game = Rendezvous(agents=agents, graph=graph, leaders=(0,))
    asked = Robustness()
    sim = World.__new__(World)
    sim.linked = adjacency(graph, agents)
    sim.slots, sim.leads = places(sim.linked, graph), np.isin(np.arange(agents), game.leaders)
    said = {name: as_json(change) for name, change in asked.perturbations(game).items()}
    assert swept(sim, as_json(asked)) == said


# --- What it does not know -----------------------------------------------------------------------


def of(game, controller, V=None):
    """The world of a certificate about these."""
    arrays = {f"controller/{k}": v for k, v in named_arrays(controller).items()}
    arrays["controller/words"] = words(controller)
    V = Quadratic(jnp.eye(shape(GAME).errors)) if V is None else V
    arrays |= {f"V/{k}": v for k, v in named_arrays(V).items()}
    arrays = {k: np.asarray(v) for k, v in arrays.items()}
    meta = {"game": game, "controller": without_arrays(controller), "V": without_arrays(V)}
    return World(json.loads(json.dumps(as_json(meta) | {"seed": 7})), arrays)


class MovingRing(Rendezvous):
    pass


OwnRendezvous = type("Rendezvous", (Rendezvous,), {"__module__": "my_game"})
OwnGreedy = type("Greedy", (Greedy,), {"__module__": "my_policy"})


def test_it_names_what_it_does_not_know():
    def of_game(game, policy=Greedy):
        controller = without_arrays(Decentralised(policy(driver(GAME).policy.pi), game))
        return unknown(*json.loads(json.dumps([as_json(game), as_json(controller)])))

    assert of_game(GAME) is None
    ring = {f: getattr(GAME, f) for f in ("agents", "leaders", "horizon", "dynamics")}
    for game, what in (
        (MovingRing(**ring), "the game MovingRing (own code)"),
        (OwnRendezvous(**ring), "the game Rendezvous (own code)"),
        (Perturbed(inner=GAME, noise=0.1), "the game Perturbed"),
        (Rendezvous(**ring, graph="disk:1.5"), "the graph disk:1.5"),
        (Rendezvous(agents=2, dynamics=SingleIntegrator(integrator="rk4")), "the integrator rk4"),
    ):
        assert of_game(game) == what
    assert of_game(GAME, OwnGreedy) == "the policy Greedy (own code)"


@pytest.fixture(scope="module")
def without_a_model(tmp_path_factory):
    """A certificate about a game that recheck has no model of."""
    game, path = CartPoles(agents=2, horizon=250), tmp_path_factory.mktemp("other") / "c"
    table = {"reach": Reach(rollouts=500, share=0.9), "quantiles": Quantiles(rollouts=500, q=0.9)}
    result = certify(game, CartFeedback(game), table, seed=1, confidence=0.99)
    save(path, result, game, CartFeedback(game))
    return path


def test_of_a_game_without_a_model_it_checks_what_follows_from_the_counts(without_a_model, capsys):
    found = recheck(without_a_model)
    assert not found["agrees"] and found["holds"] is None and found["rechecked"] == {}
    assert "no model of the game CartPoles; its bound is" in found["not_rechecked"]["reach"]
    assert main(["recheck", str(without_a_model)]) == 1
    said = capsys.readouterr().out
    assert said.count("NOT CHECKED") == 2 and "0 of 2 verdicts were derived again" in said


@pytest.mark.parametrize(
    "edit",
    [
        ("verdicts/reach/successes", lambda k: k + 3),
        ("verdicts/reach/bound", 0.97),
        ("verdicts/reach/trials", 501),
        ("verdicts/reach/confidence", 0.9999),
        ("verdicts/quantiles/holds", lambda held: not held),
        ("verdicts/reach/holds", lambda held: not held),
        ("certificates/reach/share", 2.0),
        ("policy", "0" * 64),
    ],
    ids=lambda edit: edit[0],
)
def test_of_a_game_without_a_model_it_rejects_what_contradicts_itself(
    without_a_model, tmp_path, edit
):
    with pytest.raises(Rejected):
        recheck(altered(without_a_model, tmp_path / "c", put(edit)))


def test_own_code_is_marked():
    assert as_json(GAME)["kind"] == "Rendezvous" and as_json(MovingRing())["kind"].endswith(
        "(own code)"
    )
    assert as_json(OwnRendezvous())["kind"] == "Rendezvous (own code)"
    nested = as_json(Rendezvous(dynamics=type("Unicycle", (Unicycle,), {"__module__": "x"})()))
    assert nested["dynamics"]["kind"] == "Unicycle (own code)"


# --- Its world -----------------------------------------------------------------------------------


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
    nominal = Rendezvous(agents=3, graph="path", dynamics=dynamics, headings=True, rest_weight=0.3)
    game = traced(Perturbed(inner=nominal, **change)) if change else nominal
    controller = Decentralised(Greedy(Actors(shape(nominal), 8, key=jax.random.key(2))), nominal)
    errors = shape(nominal).errors
    net = NormNet(shape(nominal), key=jax.random.key(3))
    V = Norm(net) if kind == "norm" else Quadratic(jnp.eye(errors) + 0.1)
    start = start_of(game, 7, "certify", 2)
    driver = seen_through(game, controller)
    seen = eqx.filter_jit(rollout)(game, driver, start, jax.random.key(5), 15)
    sim = of(nominal, controller, V)
    found = sim.roll(3, 15, change)
    assert np.allclose(found["x"][2], seen.state.x, atol=1e-4)
    if not change:
        assert np.allclose(sim.cost(found)[2, :15], seen.cost.mean(axis=1), rtol=1e-4)
        values = eqx.filter_jit(V.along)(game, seen, 16)
        assert np.allclose(sim.values(found, 16)[2], values, rtol=1e-3, atol=1e-4)


def test_its_double_random_numbers_are_the_seeds_own():
    key = jax.random.fold_in(jax.random.key(3), 5)
    own = fold((np.zeros(1, np.uint32), np.array([3], np.uint32)), 5)
    with jax.enable_x64(True):
        drawn = np.asarray(jax.random.uniform(key, (50, 7)))
    assert drawn.dtype == float and np.array_equal(uniform64(own, 50, 7)[0], drawn)


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


@pytest.mark.parametrize("share, confidence", [(0.9, 0.99), (0.98, 0.9999), (0.5, 0.5)])
def test_it_knows_how_many_trials_are_needed(share, confidence):
    assert needed(share, 1 - confidence) == trials_needed(1 - share, confidence)


def test_it_is_short_enough_to_be_read():
    """What has to be judged by eye: no file of it is longer than 600 lines."""
    folder = Path(marlyap.recheck.__file__).parent
    lengths = {file.name: len(file.read_text().splitlines()) for file in folder.glob("*.py")}
    assert sum(lengths.values()) < 2000 and max(lengths.values()) < 600, lengths


def test_the_worst_case_is_the_one_that_failed_worst():
    holds, badness = np.array([True, False, False, True]), np.array([9.0, 1.0, 2.0, 0.0])
    found = Found(holds, badness, {}, *np.ones((3, 4)))
    assert worst_of(GAME, 0, "certify", found)["episode"] == 2
    assert worst_of(GAME, 0, "certify", found, holds)["episode"] == 0


def test_its_quantiles_are_the_exact_ones():
    sample = np.random.default_rng(0).normal(size=500)
    assert order(sample, 0.95, 0.01) == quantile_upper_bound(sample, 0.95, 0.99)
    assert order(sample[:20], 0.95, 0.01) == np.inf
