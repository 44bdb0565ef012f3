"""evaluate, report and watch: what was asked, of whom, from which starts, and where it is put."""

import contextlib
import json
import re
import resource
from pathlib import Path

import jax
import numpy as np
import pytest

from marlyap.certificates.certify import certify, save
from marlyap.certificates.reach import Reach
from marlyap.cli import main
from marlyap.errors import UserError
from marlyap.games.dynamics import SingleIntegrator
from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import shape
from marlyap.learning.trainer import Trainer
from marlyap.report.data import Film, Frames, LogRow, Trained
from marlyap.report.gif import film_gif, film_pair_gif
from marlyap.report.png import learning_curves_png, trajectories_png
from marlyap.runs.run import Run, flatten
from marlyap.storage import store
from marlyap.tasks import Rendezvous


GAME = Rendezvous(agents=2, horizon=4, dynamics=SingleIntegrator())
SMALL = {"actor_width": 4, "critic_width": 4, "batch": 4}
FEW = ("--episodes", "20")


def untrained(place, seed=0, **fields):
    """A run that deploys the policy it began with, and logged its end."""
    rule = MASAC(constraint=Lyapunov(**fields), **SMALL)
    plan = Schedule(steps=16, environments=2, capacity=40, warmup=8)
    names = {"task": "own/path/to/tasks.py:Meet", "algorithm": "masac-lyapunov", "preset": "tuned"}
    run = Run.create(place, Trainer(GAME, rule, plan), seed, names)
    learner = rule.init(shape(GAME), jax.random.key(seed))
    handed = rule.policy(learner), rule.lyapunov(learner)
    store.write(place / "policy", "policy", flatten(handed), {"iteration": 2})
    for k in (1, 2):
        run.log({"iteration": k, "steps": 8 * k, "return": -2.0, "success": 0.1, "seconds": 1.0})
    return place


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Two seeds of one configuration, and one of another; the commands are given beside them."""
    monkeypatch.chdir(tmp_path)
    made = [untrained(Path("runs", f"a{seed}"), seed) for seed in (0, 1)]
    return [*made, untrained(Path("runs", "b0"), 0, reading="critic", weight=1.0)]


def call(capsys, *words):
    capsys.readouterr()
    code = main([str(word) for word in words])
    return code, *capsys.readouterr()


def found(capsys, *words):
    code, out, err = call(capsys, *words, "--json", *FEW)
    assert code == 0, err
    return json.loads(out), err


@contextlib.contextmanager
def full_disk(limit):
    """No file may grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_evaluate_says_nothing_across_configurations(runs, capsys):
    result, _ = found(capsys, "evaluate", *runs, "--out", "figures.json")
    assert not {"success_rate", "interval", "successes", "episodes"} & result.keys()
    assert [g["seeds"] for g in result["groups"]] == [[0, 1], [0]]
    assert [g["about"] for g in result["groups"]] == ["mean over 2 training seeds", "this policy"]
    assert [(p["a"], p["b"]) for p in result["comparisons"]] == [
        (str(a), str(runs[2])) for a in runs[:2]
    ]
    assert json.loads(Path("figures.json").read_text()) == result
    one, _ = found(capsys, "evaluate", *runs[:2])
    assert one["episodes"] == 40 and one["seeds"] == [0, 1] and one["comparisons"] == []


def test_evaluate_prints_what_it_measured(runs, capsys):
    code, out, _ = call(capsys, "evaluate", *runs, *FEW)
    words = " ".join(out.split())
    assert code == 0 and "20 held-out starts of seed 0" in words
    for column in ("success", "rest", "stays", "in .05", "m/s", "rad/s", "settled"):
        assert column in words
    assert "broken" not in words  # this game has no rules
    assert "mean over 2 training seeds" in words and "of this policy" in words
    assert words.count("McNemar") == 2 and "until 10 horizons" in words


def test_the_starts_follow_their_seed_and_can_be_drawn(runs, capsys):
    figures = lambda *w: found(capsys, "evaluate", runs[0], *w)[0]
    usual, other, drawn = figures(), figures("--seed", "5"), figures("--seed", "draw")
    assert usual["start_seed"] == 0 and other["runs"][0]["start_seed"] == 5
    assert usual["return_mean"] != other["return_mean"]
    again = figures("--seed", drawn["start_seed"])
    assert again == drawn and figures("--seed", "draw")["start_seed"] != drawn["start_seed"]
    code, _, err = call(capsys, "evaluate", runs[0], "--seed", "any")
    assert code == 2 and "seed" in err


def test_a_run_that_cannot_be_written_is_measured_all_the_same(runs, capsys):
    Path(runs[0], "evaluation.json").mkdir()
    code, out, err = call(capsys, "evaluate", runs[0], *FEW)
    assert code == 0 and "20 held-out starts" in out
    assert err.count("evaluation.json was not written") == 1 and "Traceback" not in err


def test_only_its_own_game_is_kept_in_a_run(runs, capsys):
    found(capsys, "evaluate", runs[0], "--task.size", "2")
    assert not Path(runs[0], "evaluation.json").exists()
    row = found(capsys, "evaluate", runs[0])[0]["runs"][0]
    assert json.loads(Path(runs[0], "evaluation.json").read_text()) == row


def test_an_unfinished_training_is_spoken_of(runs, capsys):
    assert "unfinished" not in found(capsys, "evaluate", runs[0])[1]
    log = Path(runs[0], "log.jsonl")
    log.write_text(log.read_text().splitlines(keepends=True)[0])
    assert "training is unfinished (8 of 16 steps)" in found(capsys, "evaluate", runs[0])[1]


def test_a_report_of_several_runs_is_beside_none_of_them(runs, capsys):
    result, _ = found(capsys, "report", *runs)
    assert result["report"] == "report.html" and not Path(runs[0], "report.html").exists()
    assert "success_rate" not in result and len(result["groups"]) == 2
    page = Path("report.html").read_text()
    assert "own/path/to" not in page.split("<h1>")[1].split("</h1>")[0] and "Meet" in page
    assert page.count("<article><h3>constraint.reading=") == 2
    assert "<h3>What differs</h3>" in page
    assert 'aria-label="success rate and interval' in page
    assert call(capsys, "report", *runs, *FEW)[0] == 0  # its own report is replaced
    Path("report.html").write_text("<title>my page</title>")
    code, _, err = call(capsys, "report", *runs, *FEW)
    assert code == 2 and "is not a report of marlyap" in err
    assert Path("report.html").read_text() == "<title>my page</title>"


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (b"\x00\xff\x13 not a log\n", "cannot be read"),
        (b"", "missing, empty or cut off"),
        (b'{"iteration": 1, "steps": 8, "success": 0.1}\n{"itera', "ends at iteration 1 of 2"),
    ],
)
def test_a_report_says_what_is_wrong_with_a_log(runs, capsys, damage, says):
    Path(runs[0], "log.jsonl").write_bytes(damage)
    _, err = found(capsys, "report", runs[0])
    notes = [line for line in err.splitlines() if "learning curves" in line]
    assert len(notes) == 1 and says in notes[0]
    page = Path(runs[0], "report.html").read_text()
    assert page.count("learning curves are missing or cut short") == 1


def test_a_report_shows_the_certificates_of_its_policy_and_its_game_alone(runs, capsys):
    run = Run.open(runs[0])
    controller = run.controller()
    table = {"reach": Reach(rollouts=50, share=0.5)}
    result = certify(run.game, controller, table, seed=0, confidence=0.9)
    save(runs[0] / "certificate", result, run.game, controller)
    shows = lambda *words: found(capsys, "report", runs[0], *words)[1]
    assert "left out" not in shows()
    page = Path(runs[0], "report.html").read_text()
    assert ">Certificates</h2>" in page and "Stability is not certified" not in page
    assert re.search(r'reach<span class="mark \w+">(not )?reached</span>', page)
    assert "it is of another game" in shows("--task.size", "2", "--out", "other.html")
    assert ">Certificates</h2>" not in Path("other.html").read_text()
    (runs[1] / "certificate").parent.joinpath("certificate").symlink_to(
        (runs[0] / "certificate").resolve()
    )
    assert "left out" in found(capsys, "report", runs[1])[1]
    assert "Stability is not certified" in Path(runs[1], "report.html").read_text()


def test_report_and_watch_show_the_game_that_was_asked(runs, capsys):
    result, _ = found(capsys, "report", runs[0], "--task.horizon", "6", "--out", "six.html")
    assert result["groups"][0]["label"].endswith("measured on horizon=6")
    films = re.search(r'id="films">(.*?)</script>', Path("six.html").read_text(), re.DOTALL)
    shown = [film for shot in json.loads(films[1]) for film in shot["films"]]
    assert shown and all(len(film["positions"]) == 7 for film in shown)
    Path("films").mkdir()
    code, _, _ = call(capsys, "watch", runs[0], "--task.horizon", "6", "--out", "films")
    page = Path("films", "film.html").read_text()
    assert code == 0 and "seed 0, on horizon=6" in page


def test_a_full_disk_costs_no_picture_that_was_there(runs, capsys):
    for verb in (("report", *FEW), ("watch",)):
        assert call(capsys, verb[0], runs[0], *verb[1:])[0] == 0
    names = ["report.html", "report-starts.png", "report-learning.png", "film.gif", "film.html"]
    before = {name: Path(runs[0], name).read_bytes() for name in names}
    with full_disk(1_000):
        for verb in (("report", *FEW), ("watch",)):
            code, _, err = call(capsys, verb[0], runs[0], *verb[1:])
            lines = [line for line in err.splitlines() if line.startswith("marlyap: ")]
            assert code == 2 and "Traceback" not in err
            assert len(lines) == 1 and "free some disk space" in lines[0]
    assert {name: Path(runs[0], name).read_bytes() for name in names} == before
    assert not [p for p in Path(runs[0]).iterdir() if p.name.startswith(".") and p.name != ".lock"]


def test_each_picture_is_whole_or_as_it_was(tmp_path):
    places = np.array([[[0.0, k / 10], [1.0, 1 - k / 10]] for k in range(9)])
    film = Film(frames=Frames(times=np.arange(9.0), positions=places), label="one")
    run = Trained(group="g", log=tuple(LogRow(s, s / 9, -1.0) for s in range(9)))
    writers = {
        "paths.png": lambda path: trajectories_png([film], path),
        "curves.png": lambda path: learning_curves_png([run], path),
        "film.gif": lambda path: film_gif(film, path),
        "pair.gif": lambda path: film_pair_gif(film, film, path),
    }
    for name, write in writers.items():
        (tmp_path / name).write_bytes(b"old")
        with full_disk(1_000), pytest.raises(UserError, match="free some disk space"):
            write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"old"
        with pytest.raises(UserError, match="nowhere"):
            write(tmp_path / "nowhere" / name)
        write(tmp_path / name)
        assert len((tmp_path / name).read_bytes()) > 1_000
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(writers)
