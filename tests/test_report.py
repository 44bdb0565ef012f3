"""The report: one safe, self-contained file that survives whatever data it is given."""

import base64
import copy
import hashlib
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

from marlyap import draw, report


HOSTILE = '</script><img onerror=alert(1) src=x> & "quoted" <!--#films-->'


def rollout(
    seed: int,
    agents: int = 3,
    steps: int = 40,
    dt: float = 0.1,
    gain: float = 2.0,
    label: str = "best",
    run: str = "seed 0",
) -> dict:
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
    path = np.array(positions)
    distance = np.linalg.norm(path - target, axis=-1)
    pairs = [[i, j] for i in range(agents) for j in range(i + 1, agents)]
    edges = [[[i, j] for i, j in pairs if np.linalg.norm(now[i] - now[j]) < 0.9] for now in path]
    return {
        "label": label,
        "start": seed,
        "run": run,
        "dt": dt,
        "radius": 0.1,
        "target": target,
        "positions": path,
        "headings": np.array(headings),
        "leaders": [True] + [False] * (agents - 1),
        "edges": edges,
        "distance": distance.max(-1),
        "lyapunov": (distance**2).sum(-1) * (1 + 0.1 * rng.uniform(size=steps + 1)),
        "cost": 2 * distance.mean(-1),
        "success": bool(distance[-1].max() <= 0.1),
    }


def trained(seed: int, algorithm: str = "masac-lyapunov", rate: float = 0.96) -> dict:
    """A run with a plausible log."""
    rng = np.random.default_rng(seed)
    steps = np.arange(1, 31) * 10_240
    success = rate / (1 + np.exp(-(steps / 2e4 - 6))) * rng.uniform(0.95, 1, 30)
    radii = [
        (r, min(1.0, rate * (1 - np.exp(-((r / 0.05) ** 1.7)))))
        for r in (0.05, 0.1, 0.15, 0.2, 0.3)
    ]
    return {
        "name": f"{algorithm}-{seed}",
        "label": f"{algorithm}, seed {seed}",
        "group": algorithm,
        "seed": seed,
        "episodes": 500,
        "successes": round(500 * rate),
        "success_rate": rate,
        "interval": [rate - 0.02, min(rate + 0.015, 1.0)],
        "radii": [
            {"radius": r, "success_rate": p, "interval": [p - 0.03, min(p + 0.03, 1)]}
            for r, p in radii
        ],
        "at_rest": {"success_rate": 0.125},
        "stayed": {"success_rate": 0.875},
        "beyond_steps": 360,
        "final_distance": {"0.5": 0.031, "0.95": 0.094, "1.0": 0.4},
        "final_speed": {"0.5": 0.11, "0.95": 0.21, "1.0": 0.3},
        "final_spin": {"0.5": 4.25, "0.95": 6.0, "1.0": 6.5},
        "rests": "circles inside the ball (median 0.11 m/s, 4.2 rad/s)",
        "settling_time": {"0.5": 1.9, "0.95": 3.4},
        "return_mean": -18.3 - seed,
        "log": [
            {"steps": int(s), "success": float(p), "return": float(-70 + 52 * p)}
            for s, p in zip(steps, success, strict=True)
        ],
    }


def team(name: str = "rendezvous masac-lyapunov", **others) -> dict:
    """Five training seeds of one configuration."""
    return {
        "label": name,
        "about": "mean over 5 training seeds",
        "success_rate": 0.9604,
        "interval": [0.7118, 0.9979],
        "episodes": 2500,
        "successes": 2401,
        "seeds": [0, 1, 2, 3, 4],
        "radius": 0.1,
        "at_rest": {"success_rate": 0.183},
        "stayed": {"success_rate": 0.9},
        "beyond_steps": 360,
        "rests": "circles inside the ball (median 0.11 m/s, 4.2 rad/s)",
        "text": "Measured on sampled starts; the decrease of L was sampled too, not proved.",
    } | others


def full_page() -> dict:
    """Everything that a report can hold."""
    films = [
        rollout(7, label="best"),
        rollout(12, label="median", gain=1.2),
        rollout(3, label="worst", gain=0.5),
    ]
    return {
        "title": "Rendezvous: three unicycles, one leader",
        "subtitle": "MASAC with the Lyapunov constraint, complete graph; one robot is told.",
        "generated": "21 November 2026",
        "starts": 7,
        "groups": [team()],
        "runs": [trained(seed, rate=0.972 - 0.006 * seed) for seed in range(5)],
        "films": films,
        "comparisons": [
            {
                "a": "masac-lyapunov, seed 0",
                "b": "masac, seed 0",
                "only_a": 31,
                "only_b": 12,
                "p_value": 0.0053,
                "text": "The first is better.",
            }
        ],
        "certificates": [
            {
                "name": "reach",
                "run": "seed 0",
                "claim": "every agent is within 0.1 m of its goal at 4 s",
                "evidence": "statistical",
                "holds": False,
                "asked": 0.98,
                "bound": 0.95229,
                "shown": "95.22 %",
                "confidence": 0.95,
                "text": "sampled",
            }
        ],
        "notes": ["runs/a: log.jsonl is cut off"],
        "changed": ["algorithm.constraint.beta"],
        "differing": [{"name": "masac-lyapunov", "fields": "constraint.beta=0.5"}],
        "training": [
            {
                "name": "seed 0",
                "command": "marlyap train rendezvous masac-lyapunov --seeds 0 1 2 3 4 --out runs",
                "made": "2026-11-21T10:00:00Z",
                "seed": 0,
                "seconds": 161.4,
                "policy": "0123456789ab",
                "versions": {"jax": "0.10.2", "machine": "x86_64"},
            }
        ],
        "config": {
            "task": {
                "name": "rendezvous",
                "agents": 3,
                "graph": "complete",
                "leaders": [0],
                "limit": 5.0,
                "radius": 0.1,
                "dt": 0.1,
            },
            "algorithm": {
                "name": "masac-lyapunov",
                "gamma": 0.95,
                "tau": 0.005,
                "constraint": {"reading": "han", "beta": 0.5, "spectral": False},
            },
            "steps": 307_200,
            "environments": 64,
        },
        "versions": {"marlyap": "0.1.0", "jax": "0.10.2", "python": "3.11.2"},
        "command": "marlyap report runs/demo",
    }


def embedded(text: str) -> list:
    """The films that the player reads; NaN or Infinity in them is an error."""
    found = re.search(r'<script type="application/json" id="films">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1], parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def text() -> str:
    return report.html(full_page())


def test_self_contained(text):
    assert len(text.encode()) < 1_000_000
    assert not re.search(
        r"https?://|//cdn|\bsrc\s*=|@import|url\(|<link|<iframe|\bfetch\(|XMLHttpRequest", text
    )
    assert "<!--#" not in text


def test_policy_allows_only_the_player(text):
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'") and f"script-src 'sha256-{digest}'" in policy


def said(text: str) -> str:
    """The words of the page, without its style and its player."""
    body = text.split("<body>")[1].split('<script type="application/json"')[0]
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", body.replace("\u202f", "")))


def test_says_what_matters(text):
    words = said(text)
    for fact in (
        "96.0 %",
        "mean over 5 training seeds; 95 % interval 71.2 – 99.8 % for the expectation over",
        "2401 of 2500 episodes",
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
        "within 0.15 m",
        "environment steps",
        "runs/a: log.jsonl is cut off",
        "asked 98.0 % shown 95.22 %",
        "reach · seed 0 not reached",
    ):
        assert fact in words, fact
    assert words.count("start 12") == 2  # on its button and under its picture
    places = [words.index(w) for w in ("marlyap train", "This report", "marlyap report runs")]
    assert places == sorted(places)


def test_several_configurations_have_no_figure_in_common():
    page = full_page()
    one = {"about": "this policy", "success_rate": 0.5, "interval": [0.4, 0.6], "seeds": [3]}
    page["groups"] = [team("weight=0.1"), team("weight=1", **one)]
    text = report.html(page)
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
    page = {"title": "t", "certificates": [{"name": "reach", "claim": "c"} | claim]}
    words = said(report.html(page))
    assert f"reach {badge} c" in words and shows in words


def test_the_level_that_was_certified_is_spoken_of_where_it_is_drawn():
    ring = [[0.0, 0.1], [0.1, 0.0], [0.0, 0.1]]
    part = {"label": "agent 0", "reach": 1.0, "radius": 0.1, "headings": False}
    for certified in (False, True):
        lines = [{"level": 1.0, "lines": [ring], "certified": certified}]
        page = {"title": "t", "certificates": [{"name": "basin"}], "slices": [part]}
        page["slices"] = [part | {"contours": lines}]
        words = said(report.html(page))
        assert ("dashed" in words) == certified and "facing right" not in words


def test_what_rises_is_named_after_its_function():
    films = [rollout(1), rollout(1) | {"function": "V"}, rollout(1) | {"lyapunov": None}]
    made = embedded(report.html({"title": "t", "films": films}))
    assert [(f["levelName"], f["rises"]) for f in made] == [
        ("L", True),
        ("V", True),
        ("cost", False),
    ]


def test_is_pure():
    page = full_page()
    before = copy.deepcopy(page)
    assert report.html(page) == report.html(page)
    assert repr(page) == repr(before)


def test_hostile_text_is_harmless():
    page = full_page()
    for key in ("title", "subtitle", "generated", "command"):
        page[key] = HOSTILE
    page["groups"] = [team(HOSTILE, **dict.fromkeys(("about", "rests", "text"), HOSTILE))]
    page["notes"] = [HOSTILE]
    page["training"][0] = dict.fromkeys(("name", "command", "made", "policy"), HOSTILE)
    page["training"][0]["versions"] = {HOSTILE: HOSTILE}
    page["differing"] = [{"name": HOSTILE, "fields": HOSTILE}]
    page["config"] = {HOSTILE: {HOSTILE: HOSTILE}}
    page["versions"] = {HOSTILE: HOSTILE}
    for run in page["runs"]:
        run["label"] = run["group"] = HOSTILE
    for film in page["films"]:
        film["label"] = film["run"] = film["start"] = HOSTILE
    page["films"][0]["run"] = "another"
    page["runs"][0]["group"] = "another"
    page["comparisons"][0] = dict.fromkeys(("a", "b", "text"), HOSTILE)
    page["certificates"][0] = dict.fromkeys(
        ("name", "run", "claim", "evidence", "bound", "confidence", "text"), HOSTILE
    )
    page["certificates"].append({"run": "another"})
    text = report.html(page)
    page["groups"] *= 2
    assert "<img" not in report.html(page)
    assert "<img" not in text and text.count("</script>") == 2 and text.count("<script") == 2
    assert embedded(text)[0]["label"] == HOSTILE


def test_embedded_data_is_what_was_given(text):
    films, page = embedded(text), full_page()
    assert [film["label"] for film in films] == ["best", "median", "worst"]
    assert np.allclose(films[1]["positions"], page["films"][1]["positions"], atol=1e-4)
    assert np.allclose(films[1]["level"], page["films"][1]["lyapunov"], rtol=1e-3)
    assert films[0]["edges"][5] == page["films"][0]["edges"][5]
    assert films[0]["levelName"] == "L"


@pytest.mark.parametrize("kind", ["nan", "none", "inf"])
def test_missing_numbers_are_dashes(kind):
    missing = {"nan": float("nan"), "none": None, "inf": float("inf")}[kind]
    page = full_page()
    page["groups"][0].update(interval=[missing, missing], successes=missing, radius=missing)
    page["groups"][0].update(at_rest={"success_rate": missing})
    page["runs"][0].update(
        success_rate=missing,
        interval=missing if kind == "none" else [missing, 1],
        return_mean=missing,
        episodes=missing,
    )
    page["runs"][0]["radii"][1].update(success_rate=missing)
    page["runs"][0]["log"][3].update({"return": missing, "success": missing})
    page["runs"][0]["final_distance"] = {"0.5": missing}
    page["config"]["steps"] = missing
    page["training"][0]["seconds"] = missing
    film = page["films"][0]
    film["positions"] = film["positions"].tolist()
    film["positions"][7][1] = [missing, missing]
    film["lyapunov"] = [missing, *film["lyapunov"][1:]]
    film["distance"] = [*film["distance"][:-1], missing]
    text = report.html(page)
    assert embedded(text)[0]["positions"][7][1] == [None, None]
    body = text.split("<main>")[1].split('<script type="application/json"')[0]
    assert report.DASH in body and not re.search(r"\b(nan|inf|None)\b", body.replace("none", ""))


def test_only_the_title_is_needed():
    assert embedded(report.html({"title": "Nothing yet"})) == []


@pytest.mark.parametrize("key", sorted(set(full_page()) - {"title"}))
def test_any_key_may_be_missing(key):
    page = full_page()
    del page[key]
    report.html(page)


@pytest.mark.parametrize("key", sorted(set(trained(0))))
def test_any_key_of_a_run_may_be_missing(key):
    page = full_page()
    for run in page["runs"]:
        del run[key]
    report.html(page)


@pytest.mark.parametrize("key", sorted(set(rollout(0)) - {"positions"}))
def test_any_key_of_a_film_may_be_missing(key):
    page = full_page()
    for film in page["films"]:
        del film[key]
    assert len(embedded(report.html(page))) == 3


def test_empty_parts():
    page = {
        "title": "",
        "groups": [{}],
        "notes": [],
        "training": [{}],
        "differing": [{}],
        "runs": [{}],
        "films": [{"positions": []}, {"positions": [[[0, 0]]]}],
        "comparisons": [{}],
        "certificates": [{}],
        "config": {"a": {}},
        "versions": {},
    }
    assert len(embedded(report.html(page))) == 1


def test_targets_per_agent():
    film = rollout(1)
    film["target"] = [[0.0, 0.5], [0.5, -0.5], [-0.5, -0.5]]
    del film["distance"]
    made = embedded(report.html({"title": "Formation", "films": [film]}))[0]
    assert made["targets"] == [[0, 0.5], [0.5, -0.5], [-0.5, -0.5]]
    away = np.linalg.norm(film["positions"] - np.array(film["target"]), axis=-1).max(-1)
    assert np.allclose(made["distance"], away, atol=1e-4)


def test_point_masses_and_constant_edges():
    film = rollout(1) | {"headings": None, "edges": np.array([[0, 1], [1, 2]]), "lyapunov": None}
    made = embedded(report.html({"title": "Points", "films": [film]}))[0]
    assert made["headings"] is None
    assert made["edges"] == [[[0, 1], [1, 2]]]
    assert made["levelName"] == "cost"


def test_several_groups_have_a_colour_each():
    page = full_page()
    page["runs"] = [trained(s, a) for a in ("masac", "masac-lyapunov") for s in range(2)]
    assert report._colours(page["runs"]) == [0, 0, 1, 1]
    report.html(page)


def test_mean_curve_ignores_gaps_and_shorter_runs():
    nan = float("nan")
    long = report.learning_curve(
        {
            "log": [
                {"steps": 0, "success": 0},
                {"steps": 10, "success": nan},
                {"steps": 20, "success": 1},
            ]
        },
        "success",
    )
    short = (np.array([0.0, 10.0]), np.array([0.0, 0.1]))
    x, y = report.mean_curve([short, long, (np.zeros(0), np.zeros(0))])
    assert x.tolist() == [0, 10] and np.allclose(y, [0, 0.3])


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3, 7), (0, 307_200), (-0.02, 0.013), (5, 5)])
def test_ticks_are_few_and_inside(low, high):
    marks = report.ticks(low, high)
    assert 1 <= len(marks) <= 9 and all(low - 1e-9 <= mark <= high + 1e-9 for mark in marks)


def test_page_and_drawings_share_their_colours(text):
    style = text.split("</style>")[0]
    assert all(colour in style for colour in (*report.PALETTE, report.ALARM))


def test_large_team_stays_small():
    films = [rollout(s, agents=10, steps=100, label=str(s)) for s in range(3)]
    assert len(report.html({"title": "Ten", "films": films})) < 1_000_000


# ---- pictures ----


def opened(path: Path):
    image = pytest.importorskip("PIL.Image")
    return image.open(path)


def test_pictures(tmp_path):
    page = full_page()
    draw.trajectories_png(page["films"], tmp_path / "paths.png")
    draw.learning_curves_png(page["runs"], tmp_path / "curves.png")
    for name in ("paths.png", "curves.png"):
        with opened(tmp_path / name) as picture:
            assert picture.format == "PNG" and min(picture.size) > 300


def test_gif(tmp_path):
    film = rollout(3)
    begin = time.process_time()
    draw.film_gif(film, tmp_path / "film.gif")
    assert time.process_time() - begin < 10  # about 1 s on an idle core
    with opened(tmp_path / "film.gif") as picture:
        assert picture.format == "GIF" and picture.n_frames == 41
    assert (tmp_path / "film.gif").stat().st_size <= 600_000


def test_gif_of_a_pair(tmp_path):
    left, right = (
        rollout(3, gain=0.7, label="MASAC"),
        rollout(3, steps=30, label="MASAC + Lyapunov"),
    )
    left["positions"][5, 1] = np.nan
    draw.film_pair_gif(
        left, right | {"lyapunov": None, "headings": None, "target": None}, tmp_path / "pair.gif"
    )
    with opened(tmp_path / "pair.gif") as picture:
        assert picture.n_frames == 41 and picture.width > 1.5 * 360
    assert (tmp_path / "pair.gif").stat().st_size <= 1_000_000


def test_long_film_keeps_the_gif_short(tmp_path):
    draw.film_gif(rollout(2, steps=400), tmp_path / "long.gif")
    with opened(tmp_path / "long.gif") as picture:
        assert picture.n_frames <= 121


def test_every_rule_of_the_style_sheet_is_one():
    """Each selector begins where a selector can begin, and the large figure has its rule."""
    from importlib.resources import files

    page = files("marlyap").joinpath("report_page.html").read_text(encoding="utf-8")
    style = page[page.index("<style>") + 7 : page.index("</style>")]
    selectors = re.findall(r"(?:^|[}\n])\s*([^{}@\n]+?)\s*\{", style)
    assert ".figure" in selectors and ".slices" in selectors
    assert [s for s in selectors if re.search(r"\.\.|[.#]\s|[.#]$", s)] == []
