"""The report: one safe, self-contained file that survives whatever data it is given."""

import base64
import dataclasses
import hashlib
import json
import re
import time
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from marlyap.errors import UserError
from marlyap.report import charts, scene
from marlyap.report.data import (
    Claim,
    Comparison,
    Difference,
    Film,
    Frames,
    Group,
    LogRow,
    Page,
    Share,
    Slice,
    Trained,
    Training,
    Within,
)
from marlyap.report.gif import film_gif, film_pair_gif
from marlyap.report.interactive import library
from marlyap.report.page import html
from marlyap.report.plot import moment
from marlyap.report.png import learning_curves_png, trajectories_png
from marlyap.report.words import DASH


HOSTILE = '</script><img onerror=alert(1) src=x> & "quoted" {{ page.title }} {% raw %}'


def rollout(
    seed: int,
    agents: int = 3,
    steps: int = 40,
    dt: float = 0.1,
    gain: float = 2.0,
    label: str = "best",
    run: str = "seed 0",
    **frames,
) -> Film:
    """A film of unicycles that steer to a target as best they can."""
    rng = np.random.default_rng(seed)
    place, target = rng.uniform(-1, 1, (agents, 2)), rng.uniform(-0.8, 0.8, 2)
    heading, speed = rng.uniform(-np.pi, np.pi, agents), np.zeros(agents)
    positions, headings = [place], [heading]
    for _ in range(steps):
        offset = target - place
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - heading
        away = np.linalg.norm(offset, axis=-1)
        heading = heading + dt * 4.0 * np.sin(bearing)
        speed = speed + dt * np.clip(3.0 * (gain * away * np.cos(bearing) - speed), -5, 5)
        place = place + dt * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
        positions, headings = [*positions, place], [*headings, heading]
    path, angles = np.array(positions), np.array(headings)
    distance = np.linalg.norm(path - target, axis=-1)
    pairs = [(i, j) for i in range(agents) for j in range(i + 1, agents)]
    near = lambda now, i, j: np.linalg.norm(now[i] - now[j]) < 0.9
    given = {
        "times": np.arange(steps + 1) * dt,
        "positions": path,
        "headings": np.stack([np.cos(angles), np.sin(angles)], axis=-1),
        "goals": np.broadcast_to(target, path.shape),
        "leaders": (True, *[False] * (agents - 1)),
        "links": tuple(tuple((i, j) for i, j in pairs if near(now, i, j)) for now in path),
        "edge": 0.1,
        "unit": "m",
    }
    given |= frames
    return Film(
        frames=Frames(**given),
        label=label,
        start=str(seed),
        run=run,
        distance=distance.max(-1),
        edge=given["edge"],
        unit=given["unit"],
        level=(distance**2).sum(-1) * (1 + 0.1 * rng.uniform(size=steps + 1)),
        level_name="L",
        rises=True,
        success=bool(distance[-1].max() <= 0.1),
    )


def trained(seed: int, algorithm: str = "masac-lyapunov", rate: float = 0.96) -> Trained:
    """A run with a plausible log."""
    rng = np.random.default_rng(seed)
    steps = np.arange(1, 31) * 10_240
    success = rate / (1 + np.exp(-(steps / 2e4 - 6))) * rng.uniform(0.95, 1, 30)
    radii = [
        (r, min(1.0, rate * (1 - float(np.exp(-((r / 0.05) ** 1.7))))))
        for r in (0.05, 0.1, 0.15, 0.2, 0.3)
    ]
    return Trained(
        name=f"{algorithm}-{seed}",
        label=f"{algorithm}, seed {seed}",
        group=algorithm,
        seed=seed,
        episodes=500,
        successes=round(500 * rate),
        success_rate=rate,
        interval=(rate - 0.02, min(rate + 0.015, 1.0)),
        unit="m",
        radii=tuple(
            Within(radius=r, success_rate=p, interval=(p - 0.03, min(p + 0.03, 1)))
            for r, p in radii
        ),
        at_rest=Share(success_rate=0.125),
        stayed=Share(success_rate=0.875),
        beyond_steps=360,
        final_distance={"0.5": 0.031, "0.95": 0.094, "1.0": 0.4},
        final_speed={"0.5": 0.11, "0.95": 0.21, "1.0": 0.3},
        final_spin={"0.5": 4.25, "0.95": 6.0, "1.0": 6.5},
        rests="circles inside the ball (median 0.11 m/s, 4.2 rad/s)",
        settling_time={"0.5": 1.9, "0.95": 3.4},
        return_mean=-18.3 - seed,
        log=tuple(
            LogRow(int(s), float(p), float(-70 + 52 * p))
            for s, p in zip(steps, success, strict=True)
        ),
    )


def team(name: str = "rendezvous masac-lyapunov", **others) -> Group:
    """Five training seeds of one configuration."""
    given = {
        "label": name,
        "about": "mean over 5 training seeds",
        "success_rate": 0.9604,
        "interval": (0.7118, 0.9979),
        "episodes": 2500,
        "successes": 2401,
        "seeds": (0, 1, 2, 3, 4),
        "radius": 0.1,
        "unit": "m",
        "at_rest": Share(success_rate=0.183),
        "stayed": Share(success_rate=0.9),
        "beyond_steps": 360,
        "rests": "circles inside the ball (median 0.11 m/s, 4.2 rad/s)",
        "text": "Measured on sampled starts; the decrease of L was sampled too, not proved.",
    }
    return Group(**given | others)


def part(**others) -> Slice:
    """A bowl around the goal."""
    grid = np.linspace(-1, 1, 21)
    values = grid[None] ** 2 + 2 * grid[:, None] ** 2
    given = {"label": "agent 0", "values": values, "reach": 1.0, "radius": 0.1, "unit": "m"}
    return Slice(**given | others)


def full_page(runs: int = 5, films: int = 3) -> Page:
    """Everything that a report can hold."""
    shown = (
        rollout(7, label="best"),
        rollout(12, label="median", gain=1.2),
        rollout(3, label="worst", gain=0.5),
    )
    return Page(
        title="Rendezvous: three unicycles, one leader",
        subtitle="MASAC with the Lyapunov constraint, complete graph; one robot is told.",
        generated="21 November 2026",
        starts=7,
        groups=(team(),),
        runs=tuple(trained(seed, rate=0.972 - 0.006 * seed) for seed in range(runs)),
        films=shown[:films],
        comparisons=(Comparison("masac-lyapunov, seed 0", "masac, seed 0", 31, 12, 0.0053),),
        claims=(
            Claim(
                name="reach",
                run="seed 0",
                claim="every agent is within 0.1 m of its goal at 4 s",
                evidence="statistical",
                holds=False,
                asked=0.98,
                bound=0.95229,
                shown="95.22 %",
                confidence=0.95,
                scope="sampled",
            ),
        ),
        slices=(part(level=0.5),),
        notes=("runs/a: log.jsonl is cut off",),
        changed=("algorithm.constraint.beta",),
        differing=(Difference("constraint.beta", ("0.5",)),),
        training=(
            Training(
                name="seed 0",
                command="marlyap train rendezvous masac-lyapunov --seeds 0 1 2 3 4 --out runs",
                made="2026-11-21T10:00:00Z",
                seed=0,
                seconds=161.4,
                policy="0123456789ab",
                versions={"jax": "0.10.2", "machine": "x86_64"},
            ),
        ),
        config={
            "task": {"name": "rendezvous", "agents": 3, "leaders": [0], "radius": 0.1, "dt": 0.1},
            "algorithm": {
                "name": "masac-lyapunov",
                "constraint": {"reading": "han", "beta": 0.5, "spectral": False},
            },
            "steps": 307_200,
        },
        versions={"marlyap": "0.1.0", "jax": "0.10.2", "python": "3.11.2"},
        command="marlyap report runs/demo",
    )


def without_library(text: str) -> str:
    """A page without Bokeh's script, which is not ours."""
    return text.replace(library(), "")


def embedded(text: str) -> list:
    """The films that the player reads; NaN or Infinity in them is an error."""
    found = re.search(r'<script type="application/json" id="films">(.*?)</script>', text, re.DOTALL)
    assert found
    shots = json.loads(found[1], parse_constant=pytest.fail)
    return [film for shot in shots for film in shot["films"]]


def drawn(text: str) -> str:
    """The charts that Bokeh reads; NaN or Infinity in them is an error."""
    found = re.search(
        r'<script type="application/json" id="charts">(.*?)</script>', text, re.DOTALL
    )
    assert found
    return json.dumps(json.loads(found[1], parse_constant=pytest.fail))


def played(*films: Film) -> list:
    """What the player reads of these films."""
    return [json.loads(json.dumps(scene.played(s))) for s in scene.scenes(films)]


@pytest.fixture(scope="module")
def text() -> str:
    return html(full_page())


def test_self_contained(text):
    assert len(text.encode()) < 2_000_000
    ours = without_library(text)
    assert not re.search(
        r"https?:|//cdn|\bsrc\s*=|@import|url\(|<link|<iframe|\bfetch\(|XMLHttpRequest", ours
    )
    assert ours.lstrip().startswith("<!doctype html>") and "{{" not in ours and "{%" not in ours


def test_policy_allows_only_these_scripts(text):
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert policy.startswith("default-src 'none'") and len(scripts) == 3
    assert policy.endswith("script-src " + " ".join(f"'sha256-{d}'" for d in digests))


def test_ids_are_unique_and_each_reference_has_one(text):
    ids = re.findall(r' id="([^"]*)"', text)
    assert len(ids) == len(set(ids)) > 10
    assert set(re.findall(r'href="#([^"]*)"', text)) <= set(ids)


def said(text: str) -> str:
    """The words of the page, without its style and its player."""
    body = text.split("<body>")[1].split('<script type="application/json"')[0]
    body = re.sub(r"<svg.*?</svg>", " ", body.replace("\u202f", ""), flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", body))


def test_says_what_matters(text):
    words = said(text)
    for fact in (
        "96.0 %",
        "mean over 5 training seeds; 95 % interval 71.2 – 99.8 % for the expectation over",
        "2401 of 2500 episodes",
        "success within 0.1 m at the last step",
        "held-out starts of seed 7",
        "circles inside the ball (median 0.11 m/s, 4.2 rad/s)",
        "at rest at the last step: 18.3 %; stays for 360 steps more: 90.0 %",
        "not proved",
        "0.0053",
        "algorithm.constraint.beta",
        "2 min 41 s",
        "0123456789ab",
        "machine x86_64",
        "4.25 / 6.00",
        "within 0.05 m",
        "Final distance (m)",
        "runs/a: log.jsonl is cut off",
        "asked 98.0 % shown 95.22 %",
        "reach · seed 0 not reached",
    ):
        assert fact in words.replace(" ;", ";"), fact
    assert "environment steps" in drawn(text) and "radius (m)" in drawn(text)
    assert words.count("start 12") == 2  # on its button and under its picture
    places = [words.index(w) for w in ("marlyap train", "This report", "marlyap report runs")]
    assert places == sorted(places)


def test_units_come_from_the_data():
    other = lambda thing: replace(thing, unit="Hz")
    page = full_page(1, 1)
    film = rollout(7, unit="Hz")
    page = replace(
        page,
        groups=(team(unit="Hz", rests=""),),
        runs=tuple(replace(other(run), final_speed={}, final_spin={}) for run in page.runs),
        films=(film,),
        slices=(part(unit="Hz"),),
        claims=(),
    )
    text = html(page)
    words = said(text)
    assert "success within 0.1 Hz" in words and "Final distance (Hz)" in words
    assert "radius (Hz)" in drawn(text)
    assert re.search(r"final distance [\d.]+ Hz", words)
    assert "largest distance (Hz)" in [s["name"] for s in embedded(text)[0]["strips"]]
    assert not re.search(r"\(m\)|\d m\b|m/s \)|speed \(m/s\)", words)


def test_several_configurations_have_no_figure_in_common():
    one = {"about": "this policy", "success_rate": 0.5, "interval": (0.4, 0.6), "seeds": (3,)}
    page = replace(full_page(), groups=(team("weight=0.1"), team("weight=1", **one)))
    text = html(page)
    words = said(text)
    assert 'class="verdict"' not in text and text.count("<article><h3>weight=") == 2
    assert "exact 95 % interval 40.0 – 60.0 % of this policy" in words
    assert text.count('class="pooled"') == 1  # the mean over the seeds of the first alone


@pytest.mark.parametrize(
    ("claim", "badge", "shows"),
    [
        ({"holds": True, "asked": 0.95, "bound": 0.96}, "reached", "shown 96.0 %"),
        (
            {"holds": False, "asked": 0.95, "bound": 0.9499, "shown": "94.99 %"},
            "not reached",
            "shown 94.99 %",
        ),
        ({"holds": False, "asked": 0.95, "bound": 0.96}, "does not hold", "bound 0.96"),
        ({"holds": True, "bound": 0.5}, "holds", "bound 0.5"),
        ({"holds": False}, "does not hold", "reach"),
    ],
)
def test_a_claim_says_what_was_asked_and_shown(claim, badge, shows):
    page = Page(title="t", claims=(Claim(name="reach", claim="c", **claim),))
    words = said(html(page))
    assert f"reach {badge} c" in words and shows in words


def test_the_level_that_was_certified_is_spoken_of_where_it_is_drawn():
    dashes = []
    for level in (None, 0.5):
        page = Page(title="t", claims=(Claim(name="basin"),), slices=(part(level=level),))
        words = said(text := html(page))
        assert ("dashed" in words) == (level is not None) and "facing right" not in words
        dashes.append(drawn(text).count("dashed"))
    assert dashes[1] > dashes[0]


def test_what_rises_is_named_after_its_function():
    film = rollout(1)
    cost = replace(film, level_name="cost", rises=False)
    made = [f["strips"][0] for f in played(film, replace(film, level_name="V"), cost)]
    assert [(s["name"], s["rises"]) for s in made] == [
        ("L (Lyapunov)", True),
        ("V (Lyapunov)", True),
        ("cost", False),
    ]


def test_only_noticeable_rises_are_marked():
    level = np.array([1.0, 0.5, 0.5 + 5e-4, 0.7, np.nan, 0.2])
    film = Film(frames=Frames(times=np.arange(6.0)), level=level, level_name="L", rises=True)
    strip = scene.scenes([film])[0].strips[0]
    assert scene.rising(strip).tolist() == [False, False, True, False, False]
    assert not scene.rising(replace(strip, rises=False)).any()


def test_is_pure():
    page = full_page(1, 1)
    before = repr(page)
    assert html(page) == html(page)
    assert repr(page) == before


def test_hostile_text_is_harmless():
    page = full_page(2)
    tell = lambda thing, *names: replace(thing, **dict.fromkeys(names, HOSTILE))
    page = tell(page, "title", "subtitle", "generated", "command")
    film = [tell(f, "label", "run", "start", "level_name") for f in page.films]
    film[0] = replace(film[0], run="another", frames=tell(film[0].frames, "unit"))
    runs = [tell(run, "label", "group", "unit") for run in page.runs]
    page = replace(
        page,
        groups=(tell(team(HOSTILE), "about", "rests", "text", "unit"),),
        notes=(HOSTILE,),
        training=(
            replace(
                tell(page.training[0], "name", "command", "made", "policy"),
                versions={HOSTILE: HOSTILE},
            ),
        ),
        differing=(Difference(HOSTILE, (HOSTILE,)),),
        config={HOSTILE: {HOSTILE: HOSTILE}},
        changed=(f"{HOSTILE}.{HOSTILE}",),
        versions={HOSTILE: HOSTILE},
        runs=(replace(runs[0], group="another"), *runs[1:]),
        films=tuple(film),
        comparisons=(Comparison(HOSTILE, HOSTILE),),
        claims=(
            tell(Claim(), "name", "run", "claim", "evidence", "bound", "confidence", "scope"),
            Claim(run="another"),
        ),
        slices=(tell(part(), "label", "unit", "run"),),
    )
    text = html(page)
    assert "<img" not in html(replace(page, groups=page.groups * 2))
    assert "<img" not in text and text.count("</script>") == 5
    assert without_library(text).count("<script") == 5
    assert embedded(text)[0]["label"] == HOSTILE
    assert text.count("{{ page.title }}") > 20  # nothing that was given is taken for a template


def test_embedded_data_is_what_was_given(text):
    made, page = embedded(text), full_page()
    assert [film["label"] for film in made] == ["best", "median", "worst"]
    assert np.allclose(made[1]["positions"], page.films[1].frames.positions, atol=1e-4)
    level, distance = (strip["lines"][0] for strip in made[1]["strips"])
    assert np.allclose(level, page.films[1].level, rtol=1e-3)
    assert np.allclose(distance, page.films[1].distance, rtol=1e-3)
    angles = np.asarray(made[1]["headings"])
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    assert np.allclose(heading, page.films[1].frames.headings, atol=1e-3)
    assert made[0]["edges"][5] == [list(pair) for pair in page.films[0].frames.links[5]]
    assert made[0]["leaders"] == [True, False, False] and made[0]["dt"] == pytest.approx(0.1)


@pytest.mark.parametrize("kind", ["nan", "none", "inf"])
def test_missing_numbers_are_dashes(kind):
    missing = {"nan": float("nan"), "none": None, "inf": float("inf")}[kind]
    page = full_page(2, 1)
    group = team(
        interval=(missing, missing),
        successes=None,
        radius=missing,
        at_rest=Share(success_rate=missing),
    )
    first = page.runs[0]
    within = (first.radii[0], replace(first.radii[1], success_rate=missing), *first.radii[2:])
    log = (*first.log[:3], LogRow(first.log[3].steps, missing, missing), *first.log[4:])
    first = replace(
        first,
        success_rate=missing,
        interval=None if missing is None else (missing, 1),
        return_mean=missing,
        episodes=None,
        radii=within,
        log=log,
        final_distance={"0.5": missing},
    )
    film = page.films[0]
    gone = np.nan if missing is None else missing
    positions, level, distance = (
        np.array(values) for values in (film.frames.positions, film.level, film.distance)
    )
    positions[7, 1], level[0], distance[-1] = gone, gone, gone
    film = replace(
        film, frames=replace(film.frames, positions=positions), level=level, distance=distance
    )
    page = replace(
        page,
        groups=(group,),
        runs=(first, *page.runs[1:]),
        films=(film,),
        config={**page.config, "steps": missing},
        training=(replace(page.training[0], seconds=missing),),
        slices=(),
    )
    text = html(page)
    assert embedded(text)[0]["positions"][7][1] == [None, None]
    body = text.split("<main>")[1].split('<script type="application/json"')[0]
    body = re.sub(r'(fill|stroke):none|"none"', "", body)
    assert DASH in body and not re.search(r"\b(nan|inf|None)\b", body)


def test_only_the_title_is_needed():
    assert embedded(html(Page(title="Nothing yet"))) == []
    records = (Group(), Trained(), Comparison(), Claim(), Training())
    assert all(dataclasses.asdict(record) for record in records)  # nothing else is asked for
    page = Page(
        title="",
        groups=(Group(),),
        runs=(Trained(),),
        films=(Film(frames=Frames(times=np.zeros(1), positions=np.zeros((1, 1, 2)))),),
        comparisons=(Comparison(),),
        claims=(Claim(),),
        differing=(Difference("", ()),),
        training=(Training(),),
        config={"a": {}},
    )
    assert len(embedded(html(page))) == 1


def without(thing, name):
    """A record as if this field had not been given."""
    field = next(f for f in dataclasses.fields(thing) if f.name == name)
    made = field.default_factory is not dataclasses.MISSING
    return replace(thing, **{name: field.default_factory() if made else field.default})


def optional(kind) -> list[str]:
    """The fields of a record that need not be given."""
    given = (dataclasses.MISSING, dataclasses.MISSING)
    return [f.name for f in dataclasses.fields(kind) if (f.default, f.default_factory) != given]


@pytest.mark.parametrize("name", optional(Page))
def test_any_part_of_a_page_may_be_missing(name):
    html(without(full_page(1, 1), name))


@pytest.mark.parametrize("name", optional(Trained))
def test_any_field_of_a_run_may_be_missing(name):
    runs = tuple(without(trained(seed), name) for seed in range(2))
    html(Page(title="t", runs=runs))


def test_any_field_of_a_film_may_be_missing():
    film = rollout(0)
    films = [without(film, name) for name in optional(Film)]
    films += [
        replace(film, frames=without(film.frames, name))
        for name in optional(Frames)
        if name != "positions"
    ]
    made = played(*films)
    assert len(made) == len(optional(Film)) + len(optional(Frames)) - 1
    assert all(len(f["positions"]) == 41 for f in made)
    bare = Film(frames=Frames(times=film.frames.times, positions=film.frames.positions))
    assert len(embedded(html(Page(title="t", films=(bare,))))) == 1


def test_goals_per_agent():
    goals = np.array([[0.0, 0.5], [0.5, -0.5], [-0.5, -0.5]])
    film = rollout(1, goals=np.broadcast_to(goals, (41, 3, 2)))
    shared, own = played(rollout(1), film)
    assert own["goals"] == [[[0, 0.5], [0.5, -0.5], [-0.5, -0.5]]]
    assert np.shape(shared["goals"]) == (1, 1, 2)  # one ring where all share their goal


def test_goals_that_move_are_shown_moving():
    film = rollout(1)
    goals = film.frames.positions + 0.1
    moving = replace(film, frames=replace(film.frames, goals=goals))
    assert np.allclose(played(moving)[0]["goals"], goals, atol=1e-4)


def test_point_masses_and_constant_links():
    film = rollout(1, headings=None, links=(((0, 1), (1, 2)),))
    made = played(film)[0]
    assert made["headings"] is None and made["edges"] == [[[0, 1], [1, 2]]]


# ---- any physics ----


def on_a_road(bodies: int = 4) -> Film:
    """Cars behind each other, with their speeds."""
    t = np.arange(31) * 0.1
    speed = 20 + np.sin(t)[:, None] * np.linspace(1, 0.2, bodies)
    x = np.cumsum(0.1 * speed, axis=0) - 10 * np.arange(bodies)
    frames = Frames(
        times=t, positions=x[..., None], signals={"speed (m/s)": speed}, unit="m", edge=1.0
    )
    return Film(frames=frames, label="platoon", distance=np.abs(speed - 20).max(1), unit="m")


def in_space() -> Film:
    """Two bodies that rise; a third is no agent and has no goal."""
    t = np.arange(21) * 0.1
    p = np.stack([np.outer(np.cos(t), [1, 2, 3]), np.outer(np.sin(t), [1, 2, 3])], axis=-1)
    p = np.concatenate([p, np.broadcast_to(0.5 * t[:, None, None], (21, 3, 1))], axis=-1)
    frames = Frames(times=t, positions=p, goals=p[:, :2] + 0.1, leaders=(True, False), unit="m")
    return Film(frames=frames, label="quadrotors")


def without_a_map() -> Film:
    """Four areas of a power system."""
    t = np.arange(31) * 0.1
    f = 50 + 0.2 * np.exp(-t)[:, None] * np.cos(3 * t[:, None] + np.arange(4))
    signals = {"frequency (Hz)": f, "load (p.u.)": np.ones((31, 4))}
    return Film(frames=Frames(times=t, signals=signals), label="areas")


def test_a_road_has_a_lane_for_each_body():
    made = played(on_a_road())[0]
    (panel,) = made["panels"]
    assert panel["lanes"] and panel["labels"] == ["x (m)", "body"]
    places = np.asarray(made["positions"])
    assert np.array_equal(places[0, :, 1], [0, -1, -2, -3]) and np.ptp(places[..., 1], 0).max() == 0
    assert np.allclose(places[..., :1], on_a_road().frames.positions, atol=1e-4)
    assert [s["name"] for s in made["strips"]] == ["largest distance (m)", "speed (m/s)"]


def test_a_rod_joins_two_bodies_of_one_colour(tmp_path):
    film = rollout(1, agents=4, rods=((0, 2), (1, 3)))
    (made,) = played(film)
    assert made["tints"] == [0, 1, 0, 1] and made["rods"] == [[0, 2], [1, 3]]
    assert played(rollout(1))[0]["tints"] == [0, 1, 2]
    (drawn,) = scene.scenes([film])
    (rods,) = [a for a in moment(drawn, drawn.panels[0], 3, trail=False)
               if isinstance(a, LineCollection) and a.get_linewidths()[0] > 2]  # fmt: skip
    ends = [[drawn.places[3, i], drawn.places[3, j]] for i, j in film.frames.rods]
    np.testing.assert_allclose(rods.get_segments(), ends)
    film_gif(film, tmp_path / "f.gif")
    assert (tmp_path / "f.gif").read_bytes()[:3] == b"GIF"


def test_space_is_seen_from_above_and_from_the_side_at_one_scale():
    shown = scene.scenes([in_space()])[0]
    above, side = shown.panels
    assert (above.axes, side.axes) == ((0, 1), (0, 2)) and side.labels == ("x (m)", "z (m)")
    assert above.window[:2] == side.window[:2]
    for panel in shown.panels:
        left, right, bottom, top = panel.window
        x, y = (shown.places[..., axis] for axis in panel.axes)
        assert left < x.min() and x.max() < right and bottom < y.min() and y.max() < top
        assert panel.height == pytest.approx((top - bottom) / (right - left))
    assert shown.leaders == (True, False, False) and shown.goals.shape[1] == 2


def test_a_game_without_a_map_shows_its_signals():
    film = without_a_map()
    made = played(film)[0]
    assert made["panels"] == [] and [s["agents"] for s in made["strips"]] == [True, True]
    frequency = made["strips"][0]
    assert np.allclose(frequency["lines"], film.frames.signals["frequency (Hz)"].T, atol=1e-4)
    low, high = frequency["span"]
    assert 49.7 < low < 50 < high < 50.3  # the axis is where the signal is, not from 0
    text = html(Page(title="t", films=(film,)))
    assert "Signals from the start" in said(text) and "frequency (Hz)</text>" in text


@pytest.mark.parametrize("film", [on_a_road(), in_space(), without_a_map()], ids=lambda f: f.label)
def test_films_of_other_physics(film, tmp_path):
    film_gif(film, tmp_path / "film.gif")
    trajectories_png([film, film], tmp_path / "paths.png")
    html(Page(title="t", films=(film,)))
    with opened(tmp_path / "film.gif") as picture:
        assert picture.n_frames == len(film.frames.times)
        first = np.asarray(picture.convert("RGB"), float)
        picture.seek(15)
        assert np.abs(np.asarray(picture.convert("RGB"), float) - first).max() > 100  # it moves


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"times": np.zeros(0)}, "times"),
        ({"positions": np.zeros((3, 2))}, "positions"),
        ({"positions": np.zeros((3, 2, 4))}, "positions"),
        ({"positions": np.zeros((2, 2, 2))}, "positions"),
        ({"headings": np.zeros((3, 2))}, "headings"),
        ({"goals": np.zeros((3, 2, 3))}, "goals"),
        ({"signals": {"speed (m/s)": np.zeros(3)}}, "speed"),
        ({"links": ((), ())}, "links"),
    ],
)
def test_frames_of_wrong_shape_are_refused(bad, told):
    good = {"times": np.arange(3.0), "positions": np.zeros((3, 2, 2))}
    with pytest.raises(UserError, match=f"^frames: .*{told}"):
        Frames(**good | bad)
    with pytest.raises(UserError, match="^film: level"):
        Film(frames=Frames(**good), level=np.zeros(2))


# ---- curves ----


def test_several_groups_have_a_colour_each():
    runs = [trained(s, a) for a in ("masac", "masac-lyapunov") for s in range(2)]
    assert charts.colours(runs) == [0, 0, 1, 1]
    assert charts.legend(runs) == ["masac (2 seeds)", "masac-lyapunov (2 seeds)"]
    chart = charts.learning(charts.Told(runs, ()), "success")
    assert chart is not None
    assert [line.thick for line in chart.lines] == [False, False, True] * 2
    assert [line.team for line in chart.lines] == [0] * 3 + [1] * 3
    assert chart.lines[2].colour == chart.lines[0].colour != chart.lines[5].colour
    for line in chart.lines[2::3]:  # the band over the seeds
        own = [other.y for other in chart.lines if other.team == line.team and not other.thick]
        np.testing.assert_allclose([line.low, line.high], [np.min(own, 0), np.max(own, 0)])
    assert charts.legend(runs[:2]) == ["masac, seed 0", "masac, seed 1"]
    html(Page(title="t", runs=tuple(runs)))


def test_mean_curve_ignores_gaps_and_shorter_runs():
    log = (LogRow(0, 0), LogRow(10, float("nan")), LogRow(20, 1))
    long = charts.learning_curve(Trained(log=log), "success")
    short = (np.array([0.0, 10.0]), np.array([0.0, 0.1]))
    x, y = charts.mean_curve([short, long, (np.zeros(0), np.zeros(0))])
    assert x.tolist() == [0, 10] and np.allclose(y, [0, 0.3])


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3, 7), (0, 307_200), (-0.02, 0.013), (5, 5)])
def test_ticks_are_few_and_inside(low, high):
    marks = scene.ticks(low, high)
    assert 1 <= len(marks) <= 9 and all(low - 1e-9 <= mark <= high + 1e-9 for mark in marks)


def test_page_and_drawings_share_their_colours(text):
    style, body = without_library(text).split("</style>")
    assert all(colour in style for colour in (*scene.PALETTE, scene.ALARM))
    assert "var(--c0)" in body and not re.search(r":#[0-9a-f]{6}", body)  # dark themes work


def test_large_team_stays_small():
    films = tuple(rollout(s, agents=10, steps=100, label=str(s)) for s in range(3))
    assert len(html(Page(title="Ten", films=films))) < 400_000


# ---- pictures ----


def opened(path: Path):
    image = pytest.importorskip("PIL.Image")
    return image.open(path)


def test_pictures(tmp_path):
    page = full_page()
    trajectories_png(page.films, tmp_path / "paths.png")
    learning_curves_png(page.runs, tmp_path / "curves.png")
    for name in ("paths.png", "curves.png"):
        with opened(tmp_path / name) as picture:
            assert picture.format == "PNG" and min(picture.size) > 300
    with pytest.raises(UserError, match="^films: "):
        trajectories_png([], tmp_path / "none.png")
    learning_curves_png([], tmp_path / "empty.png")


def test_gif(tmp_path):
    film = rollout(3)
    begin = time.process_time()
    film_gif(film, tmp_path / "film.gif")
    assert time.process_time() - begin < 10  # about 1 s on an idle core
    with opened(tmp_path / "film.gif") as picture:
        assert picture.format == "GIF" and picture.n_frames == 41
    assert (tmp_path / "film.gif").stat().st_size <= 600_000


def test_gif_of_a_pair(tmp_path):
    left, right = (
        rollout(3, gain=0.7, label="MASAC"),
        rollout(3, steps=30, label="MASAC + Lyapunov", headings=None, goals=None),
    )
    left.frames.positions[5, 1] = np.nan
    film_pair_gif(left, replace(right, level=None), tmp_path / "pair.gif")
    with opened(tmp_path / "pair.gif") as picture:
        assert picture.n_frames == 41 and picture.width > 1.5 * 360
    assert (tmp_path / "pair.gif").stat().st_size <= 1_000_000


def test_long_film_keeps_the_gif_short(tmp_path):
    film_gif(rollout(2, steps=400), tmp_path / "long.gif")
    with opened(tmp_path / "long.gif") as picture:
        assert picture.n_frames <= 121


def test_every_rule_of_the_style_sheet_is_one():
    """Each selector begins where a selector can begin, and the large figure has its rule."""
    style = files("marlyap.report").joinpath("style.css").read_text(encoding="utf-8")
    selectors = re.findall(r"(?:^|[}\n])\s*([^{}@\n]+?)\s*\{", style)
    assert ".figure" in selectors and ".slices" in selectors
    assert [s for s in selectors if re.search(r"\.\.|[.#]\s|[.#]$", s)] == []
