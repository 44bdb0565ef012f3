"""Every experiment in its quick form: tables that are resumed, figures from them alone."""

import argparse
import csv
import json
import platform
import runpy
import shutil
import sys
from pathlib import Path

import pytest


PLACE = Path(__file__).parent.parent / "experiments"
# The columns that tell the cases of a script apart. All quick forms share two compiled programs.
SCRIPTS = {
    "headline": ["algorithm"],
    "references": ["algorithm", "budget"],
    "forms": ["form", "budget"],
    "readings": ["reading", "Q", "horizon", "decrease", "weight", "budget"],
    "ingredients": ["ingredient", "budget"],
    "sizes": ["algorithm", "agents", "graph", "leaders", "budget"],
}
slow = pytest.mark.slow
every_script = pytest.mark.parametrize(
    "name", ["headline", *(pytest.param(name, marks=slow) for name in list(SCRIPTS)[1:])]
)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    root = tmp_path_factory.mktemp("experiments")
    return {"--runs": root / "runs", "--results": root / "results"}


@pytest.fixture
def script(monkeypatch, places):
    """Run a script as from the command line."""
    monkeypatch.syspath_prepend(str(PLACE))

    def run(name, *words, **others):
        where = [str(w) for pair in (places | others).items() for w in pair]
        monkeypatch.setattr(sys, "argv", [name, *words, *where])
        runpy.run_path(str(PLACE / f"{name}.py"), run_name="__main__")

    return run


def table(places, name):
    with open(places["--results"] / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def contents(directory):
    return {p: p.read_bytes() for p in directory.rglob("*") if p.suffix in (".csv", ".json")}


@slow
@every_script
def test_the_quick_form(name, script, places, monkeypatch, capsys):
    about, cases = SCRIPTS[name], 2
    script(name, "--quick", "--seeds", "0", "1")
    key = ["task", *about, "seed"]
    success = table(places, f"{name}-rendezvous-success")
    assert list(success[0])[: len(key)] == key
    assert len({tuple(r[k] for k in (*key, "radius")) for r in success}) == len(success)
    assert len(success) == cases * 2 * 5
    for row in success:
        rate = int(row["successes"]) / int(row["episodes"])
        assert float(row["success_rate"]) == rate and row["episodes"] == "20"
        assert float(row["low"]) <= rate <= float(row["high"])
        assert 0 <= float(row["at_rest"]) <= 1 and 0 <= float(row["stayed"]) <= 1
        assert float(row["speed"]) >= 0 and float(row["spin"]) >= 0
        assert len(row["policy"]) == 64 and row["machine"] == platform.machine()
    contraction = table(places, f"{name}-rendezvous-contraction")
    assert len(contraction) == cases * 2
    for row in contraction:  # 98 % of 20 starts are all of them
        assert (float(row["success_rate"]) == 1) == (float(row["beta98"]) >= float(row["beta"]))
    curves = table(places, f"{name}-rendezvous-curves")
    assert len(curves) == cases * 2 * 2 and all(0 <= float(r["success"]) <= 1 for r in curves)
    picture = places["--results"] / f"{name}-rendezvous.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    tool = json.loads((places["--results"] / f"{name}-rendezvous.json").read_text())
    assert len(tool["marlyap"]["rendezvous"]) == cases

    # Once more: nothing is trained or written again. A row that is lost is made again.
    import common

    before = contents(places["--results"])
    trained = []
    monkeypatch.setattr(common, "train", lambda runs, args: trained.extend(runs) or set())
    script(name, "--quick", "--seeds", "0", "1")
    assert trained == [] and contents(places["--results"]) == before
    # From the tables alone.
    picture.unlink()
    capsys.readouterr()
    script(name, "--draw", **{"--runs": places["--runs"] / "nowhere"})
    assert picture.exists() and "interquartile mean" in capsys.readouterr().out


@pytest.mark.slow
def test_a_row_that_is_lost_is_made_again(script, places):
    """Runs are random by their seed alone: the same row comes back."""
    name = "headline-rendezvous-success"
    path = places["--results"] / f"{name}.csv"
    if not path.exists():
        script("headline", "--quick", "--seeds", "0", "1")
    whole = table(places, name)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if ",masac,1," not in line))
    assert len(table(places, name)) == len(whole) - 5
    script("headline", "--quick", "--seeds", "0", "1")
    order = lambda rows: sorted(tuple(row.values()) for row in rows)
    assert order(table(places, name)) == order(whole)


@pytest.mark.slow
def test_robustness(script, places):
    script("robustness", "--quick", "--seeds", "0", "1")
    rows = table(places, "robustness-rendezvous")
    assert {(r["algorithm"], r["seed"], r["perturbation"], r["level"]) for r in rows} == {
        ("masac", seed, "gain", level) for seed in "01" for level in ("0.5", "1.0")
    }
    assert (places["--results"] / "robustness-rendezvous.png").exists()


def test_the_published_tables_are_read(script, places, tmp_path, capsys):
    for path in (PLACE / "results").glob("headline-rendezvous-*.csv"):
        shutil.copy(path, tmp_path)
    script("headline", "--draw", **{"--results": tmp_path})
    said = capsys.readouterr().out
    assert "success within 0.1 m" in said and "masac-lyapunov" in said and "P(" in said


def test_one_seed_is_enough_for_a_table(script, tmp_path, capsys):
    """Without an interval over seeds, and without a probability of improvement."""
    for path in (PLACE / "results").glob("headline-rendezvous-*.csv"):
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["seed"] == "0"]
        with (tmp_path / path.name).open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    script("headline", "--draw", **{"--results": tmp_path})
    said = capsys.readouterr().out
    assert "P(masac-lyapunov above masac) needs two seeds or more of each" in said
    assert "success within 0.1 m" in said and "P(masac-lyapunov above masac) =" not in said


def test_the_mean_of_a_table_has_an_interval_that_holds(script, tmp_path, capsys, monkeypatch):
    """Beside the bootstrap's: for the expectation over training seeds, of shares alone."""
    monkeypatch.syspath_prepend(str(PLACE))
    from common import estimate

    from marlyap.statistics import mean_interval

    rows = [{"success_rate": r, "successes": str(int(10 * r)), "episodes": "10"} for r in (0.5, 1)]
    assert estimate(rows).expected == mean_interval([0.5, 1.0])
    assert estimate(rows[:1]).expected is None
    assert estimate([{"success_rate": r, "successes": ""} for r in (-0.1, 0.5)]).expected is None


@every_script
def test_the_long_form_has_no_case_twice(name, script, capsys):
    script(name, "--list")
    cases = capsys.readouterr().out.splitlines()
    assert len(set(cases)) == len(cases) >= 2


def test_put_replaces_rows_of_the_same_key(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(PLACE))
    from common import labels, put, read

    args = argparse.Namespace(results=tmp_path)
    rows = [{"a": "x", "seed": s, "radius": r} for s in (0, 1) for r in (0.1, 0.2)]
    put(args, "t", ["a", "seed"], rows)
    put(args, "t", ["a", "seed"], [{"a": "x", "seed": 0, "radius": 0.3}])
    assert [r["radius"] for r in read(args, "t")] == ["0.1", "0.2", "0.3"]
    assert read(args, "nothing") == []
    two = [{"task": "t", "a": "x", "b": "1"}, {"task": "t", "a": "x", "b": "2"}]
    assert labels(two) == ["1", "2"] and labels(two[:1]) == ["x 1"]
