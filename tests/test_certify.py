"""`certify`, `recheck` and the report's certificates, by the command line, on a small run."""

import contextlib
import io
import json
import shutil

import equinox as eqx
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.games.dynamics import SingleIntegrator
from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.report.contents import certificates
from marlyap.runs.run import Run
from marlyap.storage import store
from marlyap.tasks.rendezvous import Rendezvous


pytestmark = pytest.mark.usefixtures("quick_compilation")
NAMES = ("reach", "basin", "quantiles", "linearisation")
NAMED = {"task": "rendezvous", "algorithm": "masac-lyapunov", "preset": ""}
ASKED = ("--rollouts", "400", "--confidence", "0.9", "--certificates", *NAMES)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An untrained policy of two single integrators too slow to get anywhere."""
    game = Rendezvous(agents=2, horizon=12, dynamics=SingleIntegrator((0.1, 0.1)))
    algorithm = MASAC(batch=4, actor_width=4, critic_width=4, constraint=Lyapunov(horizon=4))
    schedule = Schedule(steps=24, environments=2, steps_per_update=12, warmup=12, select_episodes=2)
    trainer = Trainer(game, algorithm, schedule)
    run = Run.create(tmp_path_factory.mktemp("certify") / "run", trainer, 0, NAMED)
    run.save(run.load()[0], 0.0)
    return run


@pytest.fixture(scope="module")
def certified(run):
    """What `certify --json` prints."""
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert main(["certify", str(run.directory), "--json", *ASKED]) == 0
    return json.loads(text.getvalue())


@pytest.fixture
def page(run, certified):
    return certificates(run, run.game, "")


def said(capsys, *words):
    """The code, what was printed, and the last line for the person."""
    capsys.readouterr()
    code = main([str(w) for w in words])
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return code, told.out, (told.err.strip().splitlines() or [""])[-1]


def test_it_says_each_verdict_and_does_not_flatter(certified):
    assert list(certified["verdicts"]) == list(NAMES) and not certified["holds"]
    assert not certified["verdicts"]["reach"]["holds"]
    assert certified["verdicts"]["reach"]["trials"] == 400


def test_it_agrees_with_itself(run, certified, capsys):
    code, out, line = said(capsys, "recheck", run.directory / "certificate")
    assert code == 0, line
    *agree, derived = out.strip().splitlines()
    for name, text in zip(NAMES, agree, strict=True):
        verdict = certified["verdicts"][name]
        mark = "holds" if verdict["holds"] else "does not hold"
        assert text == f"{name} agrees: {verdict['claim']}: {mark}."
    assert derived.endswith("4 of 4 verdicts were derived again; all agree.")


def test_the_report_has_the_claims_the_worst_starts_and_the_slices_of_V(page, certified):
    assert [c.name for c in page.claims] == list(NAMES)
    for c in page.claims:
        verdict = certified["verdicts"][c.name]
        assert (c.claim, c.bound, c.holds) == tuple(verdict[k] for k in ("claim", "bound", "holds"))
    worst = certified["verdicts"]["reach"]["worst"]
    (shown,) = [f for f in page.films if "worst for reach" in f.label]
    assert int(shown.start) == worst["episode"]
    first = shown.frames.positions[0]
    np.testing.assert_allclose(first, np.asarray(worst["state"]["x"])[:, :2], atol=1e-4)
    assert not shown.success and (shown.level_name, shown.rises) == ("V", True)
    assert [s.label for s in page.slices] == ["agent 0, a leader", "agent 1, a follower"]
    for part in page.slices:  # V is least at the goal and grows away from it
        middle = len(part.values) // 2
        assert part.values[middle, middle] == part.values.min()
        for ray in (part.values[middle, middle:], part.values[middle::-1, middle]):
            assert np.all(np.diff(ray) >= 0) and ray[-1] > ray[0]


def test_a_certificate_of_another_policy_is_not_shown(run, certified, tmp_path):
    copy = shutil.copytree(run.directory, tmp_path / "copy")
    other = Run.open(copy)
    carry = other.load()[0]
    bias = lambda c: c.best.pi.net.layers[-1].bias
    other.save(eqx.tree_at(bias, carry, bias(carry) + 0.5), 0.0)
    assert certificates(other, other.game, "").claims == ()


def test_bad_certificates_are_one_sentence(run, certified, tmp_path, capsys):
    copy = shutil.copytree(run.directory / "certificate", tmp_path / "certificate")
    for file in sorted(copy.iterdir()):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        code, out, line = said(capsys, "recheck", copy)
        assert code == 2 and out == "" and line.startswith("marlyap: "), line
        file.write_bytes(whole)
    assert said(capsys, "recheck", tmp_path / "none")[0] == 2


@pytest.mark.parametrize(
    "words, part",
    [
        (["--rollouts", "20"], "at least"),
        (["--confidence", "1"], "between 0 and 1"),
        (["--certificates", "reech"], "reach"),
        ([], "already exists"),
    ],
    ids=["few", "sure", "typo", "there"],
)
def test_bad_input_is_one_sentence_and_changes_nothing(run, certified, capsys, words, part):
    place = run.directory / "certificate"
    before = {p.name: p.read_bytes() for p in place.iterdir()}
    code, out, line = said(
        capsys, "certify", run.directory, *words, *(["--force"] if words else [])
    )
    assert code == 2 and out == "" and part in line, line
    assert {p.name: p.read_bytes() for p in place.iterdir()} == before


def test_nothing_is_silently_absent(run, tmp_path, capsys):
    """A window of 20 steps does not fit into 12: the default set says so and goes on without."""
    place = tmp_path / "default"
    code, out, _ = said(
        capsys, "certify", run.directory, "--rollouts", 400, "--confidence", 0.9, "--out", place
    )
    lines = out.strip().splitlines()
    assert code == 0 and lines[0].startswith("[statistical] reach: at least 0.00 % of starts end")
    assert lines[0].endswith("Asked 98 %, shown 0.00 % (confidence 98.00 %): not reached.")
    assert "[left out] contraction: 20 steps do not fit into an episode of 12" in out
    assert lines[-1] == "Information: each agent acts on its own observation."


def test_the_task_that_was_asked_is_the_one_certified(run, tmp_path, capsys):
    """Fields of --task change what is certified, and such a certificate is not put into the run."""
    words = ["--task.radius", "0.7", "--certificates", "reach", "--rollouts", "800"]
    code, _, line = said(capsys, "certify", run.directory, *words)
    assert code == 2 and line.startswith("marlyap: out: this certificate is not about the task")
    place = tmp_path / "asked"
    assert said(capsys, "certify", run.directory, *words, "--out", place)[0] == 0
    _, meta = store.read(place, "certificate")
    assert meta["game"]["radius"] == 0.7 and meta["verdicts"]["reach"]["scope"]["edge"] == 0.7
