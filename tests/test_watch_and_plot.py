"""`watch --compare`, MP4, figures for papers, and what `marlyap` says alone."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from marlyap.cli.entry import main
from marlyap.errors import UserError
from marlyap.report import charts, filming, paper
from marlyap.report.data import Along, Group, Trained
from marlyap.report.mp4 import films_mp4
from marlyap.runs import groups
from marlyap.tasks import TASKS


SMALL = ["--task.horizon", "5", "--episode", "1"]


def told(capsys, *words: str) -> dict:
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refusal(capsys, *words: str) -> str:
    assert main([*words]) == 2
    return capsys.readouterr().err


def films_of(page: Path) -> list[dict]:
    found = re.search(r'id="films">(.*?)</script>', page.read_text(), re.S)
    return json.loads(found[1])


def test_two_controllers_are_filmed_from_one_start(tmp_path, capsys):
    words = ["watch", "tree-pursuit", "--task", "rendezvous", *SMALL, "--out", str(tmp_path)]
    result = told(capsys, *words, "--compare", "zero", "--format", "gif", "html")
    assert [film["who"] for film in result["films"]] == ["tree-pursuit", "zero"]
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    (shot,) = films_of(tmp_path / "film.html")
    one, other = shot["films"]
    assert one["positions"][0] == other["positions"][0] != one["positions"][-1]
    assert one["panels"] == other["panels"]  # at one scale
    spans = [{strip["name"]: strip["span"] for strip in film["strips"]} for film in shot["films"]]
    assert spans[0] == spans[1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--compare", "tree-pursuits"], "did you mean 'tree-pursuit'"),
        (["--compare", "zero", "zero", "zero", "zero"], "at most 3 others"),
        (["--out", "nowhere"], "no directory nowhere"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(words, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    said = refusal(capsys, "watch", "zero", "--task", "rendezvous", *SMALL, *words)
    assert says in said and said.count("\n") == 1 and not list(tmp_path.iterdir())


def test_mp4_needs_an_encoder_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["watch", "zero", "--task", "rendezvous", "--out", str(tmp_path), "--format", "mp4"]
    assert "needs the encoder ffmpeg" in refusal(capsys, *words)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg on PATH")
def test_mp4_is_a_film(tmp_path):
    from test_report import rollout

    films_mp4([rollout(1, steps=6), rollout(2, steps=6)], tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


def test_the_reference_is_a_law_by_hand():
    assert filming.reference(TASKS["coverage"], 0) == "lloyd"  # the only one that is no floor


@pytest.mark.slow
def test_of_several_references_it_is_the_cheapest():
    assert filming.reference(TASKS["cartpoles"], 0) in ("cart-lqr", "cart-feedback")


# ---- charts ----


def run(seed: int, group: str = "a", **others) -> Trained:
    t = np.arange(5) * 0.1
    costs = np.linspace(2, 1 + seed, 5)
    strip = Along(times=t, mean=costs, low=costs - 1, high=costs + 1)
    about = {"label": f"{group}, seed {seed}", "group": group, "seed": seed}
    return Trained(**about, finals=(0.1, float("nan"), 0.4 + seed), along=strip, **others)


def test_the_distribution_counts_what_is_not_finite():
    (chart,) = charts.charts([run(0)], kinds=["distance"])
    (line,) = chart.lines
    assert line.x.tolist() == [0.1, 0.4] and np.allclose(line.y, [100 / 3, 200 / 3])


def test_a_band_is_of_a_run_alone_or_of_its_group():
    (alone,) = charts.charts([run(0)], kinds=["cost"])
    assert [line.low is not None for line in alone.lines] == [True]
    pooled = Group(label="a", along=run(3).along)
    (chart,) = charts.charts([run(0), run(1)], [pooled], ["cost"])
    assert [line.low is not None for line in chart.lines] == [False, False, True]
    assert chart.lines[2].y.tolist() == run(3).along.mean.tolist()


def test_each_game_has_its_charts_and_colours_stay():
    runs = [run(0, "a", game="x"), run(0, "b", game="y")]
    one, other = charts.charts(runs, kinds=["cost"])
    assert (one.game, other.game) == ("x", "y")
    assert one.lines[0].colour != other.lines[0].colour and other.lines[0].team == 1


def test_costs_along_an_episode_are_thinned():
    strip = charts.along(np.ones((3, 1000)) * [[1], [2], [3]], 0.5)
    assert len(strip.times) <= charts.MOST_POINTS and strip.times[1] == 0.5 * 7
    assert (strip.mean[0], strip.low[0], strip.high[0]) == pytest.approx((2, 1.1, 2.9))


def test_what_differs_between_configurations():
    rows = groups.side_by_side([{"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}, "d": 0.5}])
    assert rows == [("a.c", ["2", "3"]), ("d", ["", "0.5"])]


# ---- figures for papers ----


class Logged:
    """Two seeds of one configuration, as the logs tell them."""

    def __init__(self, monkeypatch):
        from test_report import trained

        runs = tuple(trained(s, a) for a in ("masac", "masac-lyapunov") for s in range(2))
        monkeypatch.setattr(paper, "logged", lambda opened: runs)
        monkeypatch.setattr(paper, "_each", lambda given: [])


@pytest.mark.parametrize("kind", ["pdf", "svg"])
def test_a_figure_is_vector_with_fonts_embedded(kind, tmp_path, monkeypatch):
    Logged(monkeypatch)
    axes = paper.plot(["runs"], "learning")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "masac",
        "masac-lyapunov",
    ]
    lines = [line for line in axes.lines if line.get_linewidth() > 1]
    assert (
        len({line.get_color() for line in lines})
        == len({str(line._dash_pattern) for line in lines})
        == 2
    )
    paper.save(axes.figure, tmp_path / f"fig.{kind}")
    data = (tmp_path / f"fig.{kind}").read_bytes()
    if kind == "pdf":
        assert b"/FontFile2" in data and b"/Subtype /Image" not in data


def test_the_interval_over_seeds_is_wider_than_their_range(monkeypatch):
    Logged(monkeypatch)
    axes = Figure().subplots()
    assert paper.plot(["runs"], "learning", axes, band="interval") is axes
    range_ = paper.plot(["runs"], "learning")
    high = lambda at: max(c.get_paths()[0].vertices[:, 1].max() for c in at.collections)
    low = lambda at: min(c.get_paths()[0].vertices[:, 1].min() for c in at.collections)
    assert low(axes) < low(range_) and high(axes) >= high(range_)


def test_what_cannot_be_drawn_is_refused(tmp_path, monkeypatch):
    Logged(monkeypatch)
    for given, says in (
        ({"kind": "success"}, "what: there is no chart"),
        ({"band": "box"}, "band: there is no band"),
        ({"width": 0.0}, "width"),
    ):
        with pytest.raises(UserError, match=says):
            paper.plot(["runs"], **given)
    axes = paper.plot(["runs"])
    with pytest.raises(UserError, match=r"should end in \.pdf"):
        paper.save(axes.figure, tmp_path / "fig.doc")


# ---- alone ----


def test_alone_it_says_what_people_do_first(capsys):
    assert main([]) == 0
    said = capsys.readouterr().out
    commands = re.findall(r"^  marlyap (\S+)", said, re.M)
    assert commands == ["demo", "list", "train", "report", "certify"]
