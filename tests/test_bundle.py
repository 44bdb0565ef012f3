"""Bundles: every runtime answers as JAX does, nothing altered is believed, faults brake."""

import json
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.deploy import bundle, c_source, check, contract as contracts, golden, margins, verify
from marlyap.deploy.contract import CONTRACT, GOLDEN, RUNTIME, SOURCE, STARTS, WEIGHTS
from marlyap.deploy.margins import allowed, conditions
from marlyap.deploy.plant import MOTIONS, coasted, step
from marlyap.deploy.runtime import Role, read_arrays
from marlyap.deploy.starts import played
from marlyap.errors import UserError
from marlyap.games.dynamics import DYNAMICS, Unicycle
from marlyap.learning.algorithms import ALGORITHMS
from marlyap.tasks import TASKS
from marlyap.tasks.formation_di import DisplacementFormation
from marlyap.tasks.rendezvous import Rendezvous
from tests.conftest import shrunk, untrained


needs_compiler = pytest.mark.skipif(verify.compiler() is None, reason="there is no C compiler")
FLAGS = ["-O2", "-O3 -ffast-math", "-Os -Wall -Wextra -pedantic -Werror"]


@pytest.fixture(scope="module")
def contract(small_bundle):
    return contracts.load(small_bundle)


@pytest.fixture(scope="module")
def arrays(small_bundle):
    return read_arrays(small_bundle / WEIGHTS)


@pytest.fixture(scope="module")
def pairs(small_bundle):
    return read_arrays(small_bundle / GOLDEN)


@pytest.fixture
def copy(small_bundle, tmp_path):
    """A copy of the bundle, to be spoilt."""
    return shutil.copytree(small_bundle, tmp_path / "copy")


def resealed(directory, **files):
    """Change files of a bundle and seal it again, as one who knows how would."""
    body = {k: v for k, v in contracts.load(directory).items() if k not in ("files", "sha256")}
    kept = {p.name: p.read_bytes() for p in directory.iterdir() if p.name != CONTRACT}
    kept |= {name.replace("__", "."): raw for name, raw in files.items()}
    for name, raw in kept.items():
        (directory / name).write_bytes(raw)
    (directory / CONTRACT).write_bytes(contracts.sealed(body, kept))


# --- What it says --------------------------------------------------------------------------------


def test_the_contract_says_what_a_robot_needs(contract):
    assert [r["neighbours"] for r in contract["roles"]] == [
        ["agent_1", "agent_2"],
        ["agent_0", "agent_2"],
        ["agent_0", "agent_1"],
    ]
    assert [r["leads"] for r in contract["roles"]] == [True, False, False]
    assert [u["limit"] for u in contract["action"]["channels"]] == [5.0, 5.0]
    channels = contract["observation"]["channels"]
    assert sum(c["size"] for c in channels) == contract["observation"]["size"] == 21
    assert channels[3] == {
        "name": "goal - position, 0 if not told", "size": 2, "unit": "m", "frame": "own",
    }  # fmt: skip
    assert contract["timing"]["period"] == 0.1 and contract["timing"]["max_own_age"] == 0.2


def test_a_bundle_is_small(small_bundle):
    assert sum(p.stat().st_size for p in small_bundle.iterdir()) < 800_000


def test_golden_pairs_hold_every_fault(pairs, contract):
    given = check.pairs_of(pairs, "agent_0")
    due = given["fallback"].astype(bool)
    assert np.isnan(given["own"]).any() and np.isinf(given["own"]).any()
    assert (given["present"] == 0).any(axis=1).sum() > 10 and (given["told"] == 0).any()
    assert np.isnan(given["age"]).any() and (given["age"] > 0.2).any()
    absent = ~np.isfinite(given["neighbours"]).all(axis=2) & (given["present"] == 0)
    assert (absent.any(axis=1) & ~due).any(), "what is absent may hold anything"
    assert due.sum() > 30 and (~due).sum() > 100


# --- The runtimes agree --------------------------------------------------------------------------


def test_numpy_agrees(small_bundle):
    (found,) = verify.verify(small_bundle, ["numpy"])
    assert found.pairs == 3 * golden.PAIRS and found.worst <= check.TOLERANCE and not found.fault


def test_onnx_agrees(small_bundle):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    (found,) = verify.verify(small_bundle, ["onnx"])
    assert found.worst <= check.TOLERANCE and not found.fault


@needs_compiler
@pytest.mark.parametrize("flags", FLAGS)
def test_c_agrees_and_falls_back(small_bundle, flags):
    (found,) = verify.verify(small_bundle, ["c"], flags)
    assert found.worst <= check.TOLERANCE and not found.fault


@pytest.mark.slow
def test_ten_thousand_random_inputs(small_run, small_bundle, contract, arrays):
    game, controller = small_run.game, small_run.controller()
    found = golden.drawn(game, controller, played(game, controller, 10_000).way, seed=7)
    many = {}
    for i, role in enumerate(contract["roles"]):
        given = golden.inputs(game, found, i)
        many |= {f"{role['name']}.{k}": v for k, v in given.items()}
    answers = [check.agreement(contract, many, check.by_numpy(contract, arrays))]
    if verify.compiler():
        answers.append(verify.compiled(small_bundle, contract, many, "-O2"))
    pytest.importorskip("onnxruntime")
    answers.append(check.agreement(contract, many, verify._onnx(small_bundle)))
    for answer in answers:
        assert answer.pairs == 30_000 and answer.worst <= check.TOLERANCE and not answer.fault


def test_a_batch_is_answered_as_each_alone(contract, arrays, pairs):
    given = check.pairs_of(pairs, "agent_1")
    robot = Role(contract, arrays, "agent_1")
    with np.errstate(all="ignore"):
        u, fallback = robot.command(
            given["own"], given["goal"], given["neighbours"], given["present"], given["age"]
        )
    np.testing.assert_array_equal(fallback, given["fallback"].astype(bool))
    np.testing.assert_allclose(u, given["command"], atol=1e-5)


def test_a_robot_brakes(contract, arrays):
    robot = Role(contract, arrays, "agent_0")
    own = np.array([0.0, 0.0, 0.0, 0.2, -10.0])
    near, there = np.zeros((2, 4)), np.zeros(2)
    for goal, age in ((None, 0.0), ([np.nan, 0.0], 0.0), ([0.0, 0.0], 0.3), ([0.0, 0.0], np.nan)):
        u, fallback = robot.command(own, goal, near, there, age)
        assert fallback
        np.testing.assert_allclose(u, [-2.0, 5.0])  # -v / dt, and -omega / dt at its limit
    assert not robot.command(own, [0.0, 0.0], near, there)[1]
    u, fallback = robot.command([np.nan, 0.0, 0.0, 0.2, np.inf], [0.0, 0.0], near, there)
    assert fallback
    np.testing.assert_allclose(u, [-2.0, 0.0])


def test_a_role_that_is_not_there(contract, arrays):
    with pytest.raises(ValueError, match="none called 'agent_9'; there is agent_0, agent_1"):
        Role(contract, arrays, "agent_9")


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize(
    "kind", [kind for kind, d in DYNAMICS.items() if type(d).__name__ in MOTIONS]
)
def test_the_plant_is_the_games(kind, integrator):
    from dataclasses import replace

    d = replace(DYNAMICS[kind], integrator=integrator)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((8, d.dx)).astype(np.float32)
    u = (3 * rng.standard_normal((8, d.du))).clip(-d.limits[0], d.limits[0]).astype(np.float32)
    plant = {"kind": type(d).__name__, "integrator": integrator, "limits": [*d.limits]}
    wanted = jax.vmap(lambda x, u: d.step(x, u, 0.1))(x, u)
    np.testing.assert_allclose(step(plant, x, u, 0.1), wanted, atol=3e-6)
    if integrator == "rk4" and kind != "late-unicycle":  # many small pieces end there too
        fine = coasted(plant, x.astype(float), u, 1e-4, 1000)
        np.testing.assert_allclose(fine, wanted, atol=2e-3)
    known = {type(each).__name__ for each in DYNAMICS.values()}
    assert known - {*MOTIONS} == {"UnstablePoint"}  # exported with its observation as the input


# --- What was altered is refused -----------------------------------------------------------------


def test_a_hundred_flipped_bits_are_refused(copy):
    rng = np.random.default_rng(0)
    names = sorted(p.name for p in copy.iterdir())
    for k in range(100):
        path = copy / names[k % len(names)]
        raw = path.read_bytes()
        at, bit = rng.integers(len(raw)), 1 << rng.integers(8)
        path.write_bytes(raw[:at] + bytes([raw[at] ^ bit]) + raw[at + 1 :])
        with pytest.raises(UserError):
            contracts.load(copy)
        path.write_bytes(raw)
    contracts.load(copy)


def test_missing_and_foreign_files_are_refused(copy):
    (copy / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="notes.txt does not belong"):
        contracts.load(copy)
    (copy / "notes.txt").unlink()
    (copy / RUNTIME).unlink()
    with pytest.raises(UserError, match="runtime.py is missing"):
        contracts.load(copy)


def test_a_bundle_of_a_newer_marlyap(copy):
    body = json.loads((copy / CONTRACT).read_text()) | {"schema": 99}
    (copy / CONTRACT).write_text(json.dumps(body))
    with pytest.raises(UserError, match="newer marlyap"):
        contracts.load(copy)


@needs_compiler
def test_another_weight_in_c_is_found(copy, capsys):
    text = (copy / SOURCE).read_text()
    head, _, tail = text.partition("net1_1_bias[16] = {\n")
    old, _, rest = tail.partition(",")
    resealed(
        copy, controller__c=f"{head}net1_1_bias[16] = {{\n{float(old[:-1]) + 0.5}f,{rest}".encode()
    )
    assert main(["verify", str(copy), "--with", "c"]) == 1
    assert "agent_1 differs in pair" in capsys.readouterr().out


@needs_compiler
def test_a_lost_fallback_is_found(copy):
    text = (copy / SOURCE).read_text()
    bits = "(bits & 0x7f800000u) != 0x7f800000u"
    assert bits in text
    resealed(copy, controller__c=text.replace(bits, "isfinite(x) || bits == 0").encode())
    (sound,) = verify.verify(copy, ["c"], "-O2")
    (lost,) = verify.verify(copy, ["c"], "-O2 -ffast-math")
    assert not sound.fault and "lost its fallback" in lost.fault


def test_a_missing_bias_in_numpy_is_found(copy):
    text = (copy / RUNTIME).read_text()
    assert "            x += bias\n" in text
    resealed(copy, runtime__py=text.replace("            x += bias\n", "").encode())
    assert "differs in pair" in verify.verify(copy, ["numpy"])[0].fault


@needs_compiler
def test_what_does_not_compile_is_refused_in_its_words(small_bundle):
    (found,) = verify.verify(small_bundle, ["c"], "-Dconst=5f")
    assert "does not compile" in found.fault


def test_numbers_of_c_read_back():
    for value in (5.0, 1e-8, -0.1, 3e38, 1.0 / 3):
        text = c_source.number(value)
        assert text.endswith("f") and ("." in text or "e" in text)
        assert np.float32(text[:-1]) == np.float32(value)


# --- Other games ---------------------------------------------------------------------------------


CASES = {
    "path with headings": Rendezvous(graph="path", headings=True, horizon=4),
    "disk": Rendezvous(agents=4, graph="disk:0.9", horizon=4, dynamics=DYNAMICS["late-unicycle"]),
    "places": DisplacementFormation(agents=3, horizon=4),
    "alone": Rendezvous(agents=1, horizon=4, dynamics=DYNAMICS["single-integrator"]),
    "rk4": Rendezvous(agents=2, horizon=4, dynamics=Unicycle(integrator="rk4")),
}
FAST: set[str] = set()
every_case = [pytest.param(k, marks=[] if k in FAST else [pytest.mark.slow]) for k in CASES]


@pytest.mark.parametrize("name", every_case)
def test_every_kind_of_robot(name, tmp_path):
    shared = {"shared": True} if name == "disk" else {}
    rule = shrunk(ALGORITHMS["masac"], actor_width=8, critic_width=8, **shared)
    run = untrained(tmp_path / "run", CASES[name], rule)
    contract = bundle.write(run, tmp_path / "bundle", ["numpy", "c"], starts=0)
    assert contract["sight"] is not None
    wanted = ["numpy", "c"] if verify.compiler() else ["numpy"]
    assert not any(f.fault for f in verify.verify(tmp_path / "bundle", wanted))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "consensus" else [pytest.mark.slow])
        for name in TASKS
        if not name.startswith(("rendezvous", "formation"))
    ],
)
def test_every_other_game_takes_its_whole_observation(name, tmp_path):
    rule = shrunk(ALGORITHMS["masac"], actor_width=8, critic_width=8)
    run = untrained(tmp_path / "run", TASKS[name], rule)
    contract = bundle.write(run, tmp_path / "bundle", ["numpy", "c"], starts=0)
    assert contract["sight"] is None and contract["plant"]["kind"] is None
    wanted = ["numpy", "c"] if verify.compiler() else ["numpy"]
    assert not any(f.fault for f in verify.verify(tmp_path / "bundle", wanted))
    with pytest.raises(UserError, match="takes a whole observation"):
        contracts.for_robots(contract, "swarm")


def test_a_policy_that_no_bundle_can_express(tmp_path):
    rule = shrunk(ALGORITHMS["centralised-sac"], actor_width=8, critic_width=8)
    run = untrained(tmp_path / "run", Rendezvous(agents=2, horizon=4), rule)
    with pytest.raises(UserError, match="policy of kind Joint is not one network for each agent"):
        bundle.write(run, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


# --- The command line ----------------------------------------------------------------------------


def test_margins_and_the_delay_that_follows(small_run, tmp_path, monkeypatch, capsys):
    kept = ("integrator", "5 ms", "20 ms", "agent_1 dead from period 5, absent")
    some = lambda c: [row for row in conditions(c) if any(word in row[0] for word in kept)]
    monkeypatch.setattr(margins, "conditions", some)
    out = tmp_path / "bundle"
    assert (
        main(
            [
                "export",
                str(small_run.directory),
                "--out",
                str(out),
                "--with",
                "numpy",
                "--starts",
                "20",
            ]
        )
        == 0
    )
    contract = contracts.load(out)
    assert contract["evidence"]["success"]["episodes"] == 20
    rows = {row["what"]: row for row in contract["margins"]}
    assert rows["commands 20 ms late"]["faults"] == {"command_delay": 0.02}
    assert rows["agent_1 dead from period 5, absent"]["episodes"] == 20
    assert contract["timing"]["max_actuation_delay"] is None  # a random policy stands nothing
    assert "Commands may come none late" in capsys.readouterr().out
    assert read_arrays(out / STARTS)["x"].shape == (100, 3, 5)


def test_the_largest_delay_that_is_stood():
    row = lambda low, **faults: {"faults": faults, "interval": [low, 1.0]}
    rows = [row(0.99, pieces=False), row(0.99), row(0.97, command_delay=0.02)]
    rows += [row(0.2, loss=0.9), row(0.96, command_delay=0.04), row(0.9, command_delay=0.05)]
    rows += [row(0.99, command_delay=0.06)]
    assert allowed(rows) == 0.04 and allowed([row(0.5)]) is None


def test_bad_words(small_bundle, small_run, tmp_path, capsys):
    for words, said in (
        (["verify", tmp_path], "holds no contract.json"),
        (["verify", small_run.directory], "is a run; export it first"),
        (["export", small_run.directory, "--out", small_bundle], "already exists"),
        (["agent", small_bundle, "agent_7"], "role: there is none called 'agent_7'"),
        (["swarm", small_bundle, "--kill", "agent_1"], "kill: 'agent_1' is not ROBOT@SECONDS"),
        (["swarm", small_bundle, "--episodes", "1000"], "episodes: 1000 is out of range"),
        (["swarm", small_bundle, "--loss", "2"], "loss: 2.0 is out of range"),
        (["swarm", small_bundle, "--team", "a/b"], "team: 'a/b' must be"),
    ):
        assert main([str(word) for word in words]) == 2
        assert said in capsys.readouterr().err


def test_without_onnx_the_mend_is_said(small_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    words = [
        "export",
        str(small_run.directory),
        "--out",
        str(tmp_path / "b"),
        "--with",
        "onnx",
        "--starts",
        "0",
    ]
    assert main(words) == 2
    assert "pip install 'marlyap[robots]'" in capsys.readouterr().err


WITHOUT_JAX = """
import sys
sys.modules.update(dict.fromkeys(("jax", "jaxlib", "equinox", "jaxtyping", "onnx"), None))
from marlyap.cli import main
bundle = sys.argv[1]
codes = [main(["verify", bundle, "--with", *sys.argv[2:]])]
words = "--bus local --episodes 1 --lock --out film"
codes.append(main(["swarm", bundle, *words.split()]))
sys.exit(any(codes))
"""


def test_all_but_export_works_without_jax(small_bundle, tmp_path):
    runtimes = ["numpy", *(["c"] if verify.compiler() else [])]
    words = [sys.executable, "-c", WITHOUT_JAX, str(small_bundle), *runtimes]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "numpy: 576 golden pairs agree" in done.stdout
    assert (tmp_path / "film/film.gif").stat().st_size > 1000
