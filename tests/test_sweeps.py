"""Sweeps: plans that are refused, folders that are the truth, and runs that end as single ones."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from marlyap.cli import main
from marlyap.errors import UserError
from marlyap.runs.curves import columns
from marlyap.runs.job import Launch
from marlyap.runs.run import Run
from marlyap.storage import store
from marlyap.sweeps import go, plan as plans, table
from marlyap.sweeps.check import checked
from marlyap.sweeps.drive import DEATHS, Listed, drive
from marlyap.sweeps.engine import Ended
from marlyap.sweeps.folder import Sweep
from marlyap.sweeps.jobs import Entry, Job, held, status
from marlyap.sweeps.plan import Plan, Range, Search, canonical, name_of, of_data
from marlyap.sweeps.train import train
from marlyap.sweeps.unit import Unit


SMALL = {
    "task.agents": "2",
    "task.horizon": "4",
    "task.dynamics": "single-integrator",
    "schedule.steps": "48",
    "schedule.environments": "2",
    "schedule.steps_per_update": "4",
    "schedule.warmup": "8",
    "schedule.capacity": "40",
    "schedule.select_every": "3",
    "schedule.select_episodes": "4",
    "algorithm.actor_width": "4",
    "algorithm.critic_width": "4",
    "algorithm.batch": "4",
}
FIXED = {"task": "rendezvous", "algorithm": "masac"} | SMALL
RATES = ("0.001", "0.003")


def plan(**more):
    return Plan(fixed=FIXED, **({"grid": {"algorithm.rate_Q": RATES}} | more))


# --- Plans ---------------------------------------------------------------------------------------


def data(**more):
    return {"task": "rendezvous", "algorithm": "masac"} | more


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"task": "rendezvous"}, "algorithm: the sweep names none"),
        (data(speed=3), "speed: there is no such entry"),
        (data(grid={"algorithm.rate_Q": []}), "grid.algorithm.rate_Q: the list is empty"),
        (data(grid={"algorithm.rate_Q": 1e-3}), "is no list"),
        (data(grid={"rate_Q": [1]}), "rate_Q: it cannot be set"),
        (data(cells=[]), "cells: the list is empty"),
        (data(cells=[{"algorithm.tau": 0.1}], grid={"algorithm.tau": [0.2]}), "it is set in grid"),
        (
            data(grid={"task.agents": [2, 3]}, search={"algorithm.tau": {"low": 0.1, "high": 1}}),
            "search: it stands without a grid",
        ),
        (data(seeds=[0, 0]), "seeds: 0 0 names a seed twice"),
        (data(seeds=[]), "seeds: they have to be a list"),
        (data(seeds=["many"]), "'many' is not a whole number"),
        (data(evaluate=-1), "evaluate: -1 is out of range"),
        (data(search={"trials": 3}), "search: no field is searched"),
        (data(search={"algorithm.tau": {"low": 1, "high": 0}}), "it needs numbers low < high"),
        (data(search={"algorithm.tau": {"low": 0, "high": 1, "log": True}}), "needs low > 0"),
        (data(search={"algorithm.tau": {"low": 0.1, "high": 1}, "metric": "joy"}), "success or"),
        (data(grid={f"algorithm.x{k}": list(range(100)) for k in range(4)}), "take 1000000 at"),
    ],
)
def test_a_bad_plan_is_one_sentence(given, says):
    with pytest.raises(UserError) as refused:
        of_data(given)
    assert says in str(refused.value) and str(refused.value).endswith(".")


def test_a_file_that_is_no_plan_is_named(tmp_path):
    for text, says in (("= 3", "is not sound TOML"), ("speed = 3", "there is no such entry")):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(UserError, match=f"bad.toml.*{says}"):
            plans.of_toml(tmp_path / "bad.toml")
    with pytest.raises(UserError, match="cannot be read"):
        plans.of_toml(tmp_path / "none.toml")


def test_the_plans_of_the_page_can_be_trained():
    page = (Path(__file__).parents[1] / "docs" / "sweeps.md").read_text()
    blocks = re.findall(r"^```toml\n(.*?)^```", page, re.S | re.M)
    whole = [block for block in blocks if block.startswith("task")]
    assert len(whole) == 2 and len(checked(of_data(tomllib.loads(whole[0])))) == 4
    for block in blocks:
        text = block if block in whole else f'task = "rendezvous"\nalgorithm = "masac"\n{block}'
        checked(of_data(tomllib.loads(text)))


@pytest.mark.parametrize("a, b", [("1e-3", "0.001"), ("1e5", "100_000"), ("2.0,2", "2,2.0")])
def test_the_same_number_has_one_name(a, b):
    assert canonical(a) == canonical(b)
    assert name_of({"algorithm.x": canonical(a), "task": "t"}) == name_of(
        {"task": "t", "algorithm.x": canonical(b)}
    )


def test_cells_are_the_list_times_the_grid_and_words_say_the_same():
    listed = of_data(
        data(
            cells=[{"algorithm": {"tau": 0.01}}, {"algorithm.tau": 0.02}],
            grid={"algorithm": {"rate_Q": [1e-3, 3e-3]}},
            fixed={"schedule": {"steps": 100}},
        )
    )
    chosen = [(c["algorithm.tau"], c["algorithm.rate_Q"]) for c in listed.expanded()]
    assert chosen == [("0.01", "0.001"), ("0.01", "0.003"), ("0.02", "0.001"), ("0.02", "0.003")]
    assert listed.varied == ["algorithm.tau", "algorithm.rate_Q"] and listed.count == 4
    typed = plans.of_words("rendezvous", "masac", ["algorithm.rate_Q=1e-3,.003"], {}, ["0"])
    file = of_data(data(grid={"algorithm.rate_Q": [0.001, 0.003]}))
    assert typed == file and Plan.of_json(json.loads(json.dumps(file.to_json())), "x") == file


@pytest.mark.parametrize(
    ("grid", "says"),
    [
        ({"algorithm.rate_q": ("1",)}, "cell 1: algorithm.rate_q: there is no field 'rate_q'"),
        (
            {"algorithm.rate_Q": tuple(map(str, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 7)))},
            "cell 7: algorithm.rate_Q: 7.0 is out of range",
        ),
        ({"algorithm.rate_Q": ("0.001", "0.002", "0.001")}, "cells 1 and 3 are alike"),
        ({"algorithm.rate_Q": ("0.003", "0.003")}, "cells 1 and 2 are alike"),
        ({"task.agents": ("3", "none")}, "cell 2: task.agents: 'none' is not a whole number"),
    ],
)
def test_a_bad_cell_is_named_before_anything_starts(grid, says, tmp_path):
    fixed = {k: v for k, v in FIXED.items() if k not in grid}
    with pytest.raises(UserError) as refused:
        go.make_sweep(Plan(fixed=fixed, grid=grid), tmp_path / "q")
    assert str(refused.value).startswith(says) and not (tmp_path / "q").exists()


def test_a_default_that_is_written_out_is_the_same_cell(tmp_path):
    cells = ({"algorithm.tau": "0.005"}, {"algorithm.alpha": "0.1"})
    with pytest.raises(UserError, match="cells 1 and 2 are alike"):
        go.make_sweep(Plan(fixed=FIXED, cells=cells), tmp_path / "q")


def test_cells_that_differ_in_floats_share_a_program(tmp_path):
    grid = {"algorithm.rate_Q": RATES, "algorithm.actor_width": ("4", "5")}
    fixed = {k: v for k, v in FIXED.items() if k not in grid}
    cells = go.make_sweep(Plan(fixed=fixed, grid=grid), tmp_path / "q").cells
    by_width = [{c.program for c in cells if c.set["algorithm.actor_width"] == w} for w in "45"]
    assert [len(found) for found in by_width] == [1, 1] and by_width[0] != by_width[1]


def test_the_command_line_says_a_bad_sweep_in_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, says in (
        (["rendezvous", "masac", "--grid", "algorithm.rate_Q=2"], "cell 1: algorithm.rate_Q: 2.0"),
        (["rendezvous", "masac", "--grid", "algorithm.rate_Q"], "is not FIELD=VALUE,VALUE"),
        (["rendezvous"], "name a TOML file, a task and an algorithm"),
        (["status", "nowhere"], "is not a sweep"),
        (["run"], "takes the directory of one sweep"),
    ):
        assert main(["sweep", *words]) == 2
        told = capsys.readouterr().err
        assert says in told and told.count("\n") == 1
    assert not list(tmp_path.iterdir())


# --- The folder ----------------------------------------------------------------------------------


def made(directory, plan=None, cells=3):
    """A sweep that nobody has checked: without JAX."""
    plan = plan or Plan(fixed=FIXED, seeds=(0, 1))
    return Sweep.make(directory, plan, [Entry(f"c{k}", {"x": str(k)}, 6) for k in range(cells)])


def test_each_state_is_read_off_the_folder(tmp_path):
    sweep = made(tmp_path / "q")
    jobs = sweep.jobs
    for job in jobs[1:]:
        job.directory.mkdir(parents=True)
        job.beside("lock").touch()
        store.append_line(job.directory / "log.jsonl", '{"iteration": 3, "steps": 30}')
    store.write_text_atomic(jobs[1].directory / "result.json", '{"success": 0.5, "steps": 60}')
    jobs[2].beside("failed").write_text("it diverged.\n")
    jobs[3].beside("drop").touch()
    with held(jobs[4]) as mine, held(jobs[4]) as again:
        assert mine and not again
        states = [s.state for s in sweep.statuses()]
    assert states == ["waiting", "finished", "failed", "dropped", "running", "stopped"]
    assert status(jobs[2]).says == "it diverged." and status(jobs[5]).share == 0.5
    found = columns(table.rows(sweep.plan, sweep.statuses()))
    assert found["status"].tolist()[:2] == ["waiting", "finished"]
    assert found["steps"].tolist()[1] == 60 and np.isnan(found["steps"][0])


def test_another_plan_keeps_the_runs_and_nothing_else_is_overwritten(tmp_path):
    sweep = made(tmp_path / "q")
    (tmp_path / "q" / "c0").mkdir()
    assert len(made(tmp_path / "q", cells=5).jobs) == 10 and (tmp_path / "q" / "c0").is_dir()
    assert Sweep.open(sweep.directory).plan == sweep.plan
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="is no sweep"):
        made(tmp_path / "mine")
    with store.lock(sweep.directory), pytest.raises(UserError, match="in use"):
        made(tmp_path / "q")


def test_status_and_table_need_no_jax(tmp_path):
    sweep = made(tmp_path / "q")
    (sweep.directory / "c0").mkdir()
    (sweep.directory / "c0" / "seed1.failed").write_text("J_Q: it diverged.\n")
    code = f"""
import sys
from marlyap.cli import main
codes = [main(["sweep", verb, {str(sweep.directory)!r}]) for verb in ("status", "table")]
print(codes, {{"jax", "equinox", "pandas", "optuna", "ray", "submitit"}} & {{*sys.modules}})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[0, 0] set()" and "5 waiting, 1 failed" in done.stderr
    assert "c0/seed1: J_Q: it diverged." in done.stderr
    assert (sweep.directory / "table.csv").read_text().count("\n") == 7


# --- The driver, with an engine that does not train -----------------------------------------------


class Fake:
    """Ends each unit as `what` says, in the order in which they came."""

    slots = 2

    def __init__(self, what):
        self.what, self.queue, self.started = what, [], []

    def start(self, unit):
        assert len(self.queue) < self.slots
        self.queue.append(unit)
        self.started.append([job.name for job in unit.jobs])

    def ended(self, seconds):
        if not self.queue:
            return []
        unit = self.queue.pop(0)
        return [Ended(unit, self.what(unit))]

    def stop(self):
        self.queue.clear()


def finished(unit):
    for job in unit.jobs:
        job.directory.mkdir(parents=True, exist_ok=True)
        store.write_text_atomic(job.directory / "result.json", "{}")


def run_with(sweep, engine, how=None, **more):
    *_, last = drive(sweep, engine, Listed(sweep), how or Launch(), **more)
    return {s.job.name: s for s in last}


def test_every_job_is_started_once_and_never_again(tmp_path):
    sweep, engine = made(tmp_path / "q"), Fake(finished)
    assert {s.state for s in run_with(sweep, engine).values()} == {"finished"}
    assert engine.started == [[job.name] for job in sweep.jobs]
    again = Fake(finished)
    run_with(Sweep.open(sweep.directory), again)
    assert again.started == []


def test_a_process_that_dies_is_replaced_until_it_gets_nowhere(tmp_path):
    sweep, seen = made(tmp_path / "q", cells=2), []

    def dies(unit):
        bad = unit.name == "c0/seed1"
        seen.append(unit.name)
        return "its process was killed by signal 9" if bad else finished(unit)

    last = run_with(sweep, Fake(dies))
    assert seen.count("c0/seed1") == DEATHS and last["c0/seed1"].state == "failed"
    assert last["c0/seed1"].says.endswith(f"killed by signal 9, {DEATHS} times in a row.")
    assert [s.state for s in last.values()].count("finished") == 3
    assert run_with(sweep, Fake(finished))["c0/seed1"].state == "failed"
    assert run_with(sweep, Fake(finished), retry=True)["c0/seed1"].state == "finished"


def test_one_program_takes_the_jobs_of_its_cells_together(tmp_path):
    plan = Plan(fixed=FIXED, seeds=(0, 1))
    cells = [Entry(f"c{k}", {}, 6, "ab"[k // 2]) for k in range(3)]
    engine = Fake(finished)
    run_with(Sweep.make(tmp_path / "q", plan, cells), engine, Launch(parallel="vmap"))
    assert [len(unit) for unit in engine.started] == [4, 2]


def test_a_unit_is_one_line(tmp_path):
    job = Job(tmp_path, Entry("abc", {"task": "x"}, 6, "p", 3), 1)
    unit = Unit((job,), Launch(on_nan="rollback"), 20, 1)
    assert "\n" not in unit.to_json() and Unit.from_json(unit.to_json()) == unit


# --- Training ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A sweep whose jobs were trained here."""
    cells = ({"algorithm.rate_pi": "0.001"}, {"algorithm.rate_pi": "0.003"})
    fixed = {
        k: v for k, v in SMALL.items() if k not in ("algorithm.critic_width", "algorithm.batch")
    }
    fixed |= {"task": "rendezvous", "algorithm": "apg"}  # compiled in a fifth of the time of masac
    sweep = go.make_sweep(
        Plan(fixed=fixed, cells=cells, seeds=(5,), evaluate=10), tmp_path_factory.mktemp("s") / "q"
    )
    for job in sweep.jobs:
        train(Unit((job,), Launch(), sweep.plan.evaluate), lambda: False)
    return sweep


def test_a_job_is_the_run_that_train_makes(trained, tmp_path):
    for job, seen in zip(trained.jobs, trained.statuses(), strict=True):
        assert seen.state == "finished" and not job.beside("failed").exists()
        run = Run.open(job.directory)
        words = ["rendezvous", "apg", "--seeds", "5", "--out", str(tmp_path / job.cell.name)]
        fields = [w for k, v in job.cell.set.items() if "." in k for w in (f"--{k}", v)]
        if job is trained.jobs[1]:  # one is enough: each costs a compilation
            assert main(["train", *words, *fields]) == 0
            single = Run.open(tmp_path / job.cell.name / "seed5")
            sha = lambda r: store.hash_arrays(r.checkpoints.latest().arrays)
            assert sha(single) == sha(run)
        assert seen.result is not None and seen.result["episodes"] == 10
        assert seen.result["steps"] == run.history()[-1]["steps"]
    hashes = {s.result["policy"] for s in trained.statuses()}
    assert len(hashes) == 2  # the rates differ, so the policies do


def test_a_finished_job_is_left_alone(trained):
    job = trained.jobs[0]
    before = (job.directory / "result.json").stat()
    train(Unit((job,), Launch(), 10), lambda: False)
    assert (job.directory / "result.json").stat() == before


def test_tables_and_curves_are_columns(trained):
    rows, curves = trained.table(), trained.curves()
    assert list(rows["algorithm.rate_pi"]) == [0.001, 0.003]
    assert all(0 <= x <= 1 for x in rows["held_out"])
    assert {*curves["metric"]} >= {"J_pi", "success", "return"}
    run = Run.open(trained.jobs[0].directory)
    names = {path.name.partition(".")[0] for path in run.directory.iterdir()}
    assert names >= {"log", "events"} and (run.directory / "log.csv").is_file()
    one = run.curves()
    assert list(one["steps"]) == [line["steps"] for line in run.history()]
    assert np.isnan(np.asarray(one["success"], float)).any()


def test_what_cannot_be_trained_says_why_beside_its_run(tmp_path):
    own = tmp_path / "own.py"
    own.write_text("raise ValueError('nothing here')\n")
    job = Job(tmp_path, Entry("abc", FIXED | {"task": f"{own}:Mine"}, 6), 0)
    train(Unit((job,), Launch()), lambda: False)
    assert status(job).state == "failed" and "own.py:1: ValueError" in status(job).says


def test_a_run_with_other_settings_than_its_name_is_refused(trained, tmp_path):
    there = trained.jobs[0].directory
    job = Job(tmp_path, Entry("abc", trained.cells[1].set, 6), 5)
    job.directory.parent.mkdir()
    os.symlink(there, job.directory)
    (job.directory / "result.json").rename(tmp_path / "kept.json")
    try:
        train(Unit((job,), Launch()), lambda: False)
    finally:
        (tmp_path / "kept.json").rename(there / "result.json")
    assert "was made with other settings" in status(job).says or job.beside("failed").exists()


# --- Killed --------------------------------------------------------------------------------------


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_killing_the_driver_leaves_no_orphan_and_the_next_one_finishes(tmp_path):
    """Early on, while the process of a job starts; reliability/kill_sweep.py has the rest."""
    sweep = go.make_sweep(plan(seeds=(0,)), tmp_path / "q")
    words = [sys.executable, "-m", "marlyap", "sweep", "run", str(sweep.directory)]
    driver = subprocess.Popen([*words, "--workers", "1"], stderr=subprocess.DEVNULL)
    children = []
    for _ in range(600):
        children = subprocess.run(
            ["ps", "-o", "pid=", "--ppid", str(driver.pid)], capture_output=True, text=True
        ).stdout.split()
        if children:
            break
        time.sleep(0.1)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    for _ in range(600):
        if not any(map(alive, children)):
            break
        time.sleep(0.1)
    assert children and not any(map(alive, children))
    engine = Fake(finished)
    last = run_with(sweep, engine)  # nothing of the dead one keeps a job
    assert {s.state for s in last.values()} == {"finished"} and len(engine.started) == 2


# --- Engines, and a search -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """Eight tiny jobs, trained by the processes of this machine."""
    return ran(tmp_path_factory.mktemp("local") / "q", "local")


def ran(place, on, options=None):
    grid = {"algorithm.rate_Q": RATES, "algorithm.tau": (0.005, 0.01)}
    sweep = go.make_sweep(plan(grid=grid, seeds=(0, 1)), place)
    *_, last = go.run_sweep(sweep, on, 2, options=options)
    assert {s.state for s in last} == {"finished"}, [s.says for s in last]
    return {s.job.name: s.result["policy"] for s in last}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("on", "package", "options"),
    [("ray", "ray", {"num_cpus": "2"}), ("slurm", "submitit", {"cluster": "local"})],
)
def test_a_sweep_is_the_same_wherever_it_runs(on, package, options, local, tmp_path):
    pytest.importorskip(package)
    found = ran(tmp_path / "q", on, options)
    assert found == local and len(found) == 8 and len({*found.values()}) > 2


@pytest.mark.parametrize(("on", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_an_engine_that_is_not_installed_is_one_sentence(on, package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=rf"^on: {on} needs {package}; install it with pip install"):
        [*go.run_sweep(made(tmp_path / "q"), on)]


def test_an_engine_that_is_unknown_is_named(tmp_path):
    for on, options, says in (("moon", None, "^on: 'moon' must be"), ("local", {"a": "b"}, "no o")):
        with pytest.raises(UserError, match=says):
            [*go.run_sweep(made(tmp_path / "q"), on, options=options)]


SEARCH = Search(
    ranges={
        "algorithm.rate_Q": Range(1e-4, 1e-2, log=True),
        "algorithm.batch": Range(2, 6, whole=True),
        "algorithm.heads": Range(choices=("team", "agent")),
    },
    trials=7,
)


def searched(place, what=finished):
    """A search whose jobs end at once; the plan fixes what is not searched."""
    pytest.importorskip("optuna")
    from marlyap.sweeps.search import Searched

    fixed = {k: v for k, v in FIXED.items() if k not in SEARCH.ranges}
    sweep = go.make_sweep(Plan(fixed=fixed, search=SEARCH, seeds=(0, 1)), place)
    engine = Fake(what)
    *_, last = drive(sweep, engine, Searched(sweep), Launch())
    return sweep, engine, last


def good(unit):
    """Success grows with the learning rate."""
    for job in unit.jobs:
        job.directory.mkdir(parents=True, exist_ok=True)
        best = float(job.cell.set["algorithm.rate_Q"]) * 100
        store.write_text_atomic(job.directory / "result.json", json.dumps({"best": best}))


def test_a_search_proposes_cells_that_can_be_trained_and_remembers_them(tmp_path, monkeypatch):
    monkeypatch.setattr("marlyap.sweeps.drive.LOOK", 0.0)
    monkeypatch.setattr("marlyap.sweeps.drive.SHARE", 1e9)
    sweep, engine, last = searched(tmp_path / "q", good)
    assert len(engine.started) == len(last) == 14 and {s.state for s in last} == {"finished"}
    assert len({cell.name for cell in sweep.cells}) == 7
    assert {cell.set["algorithm.heads"] for cell in sweep.cells} == {"team", "agent"}
    _, again, last = searched(tmp_path / "q", good)  # it is over: nothing is proposed
    assert again.started == [] and len(last) == 14


def test_a_search_that_is_cut_short_takes_up_its_trials(tmp_path, monkeypatch):
    monkeypatch.setattr("marlyap.sweeps.drive.LOOK", 0.0)
    monkeypatch.setattr("marlyap.sweeps.drive.SHARE", 1e9)

    def dies(unit):
        if len(left) == 3:
            raise KeyboardInterrupt
        left.append(unit.name)
        good(unit)

    left: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        searched(tmp_path / "q", dies)
    before = [cell.name for cell in Sweep.open(tmp_path / "q").cells]
    sweep, engine, last = searched(tmp_path / "q", good)
    assert [cell.name for cell in sweep.cells][: len(before)] == before
    assert {s.state for s in last} == {"finished"} and len(last) == 14
    assert not {name for unit in engine.started for name in unit} & {*left}


def test_what_does_badly_is_given_up(tmp_path, monkeypatch):
    """A job's success is the same at every look; from the fifth trial on each is worse."""
    monkeypatch.setattr("marlyap.sweeps.drive.LOOK", 0.0)
    monkeypatch.setattr("marlyap.sweeps.drive.SHARE", 1e9)
    ranks: dict[str, int] = {}

    class Slow(Fake):
        def ended(self, seconds):
            for unit in [*self.queue]:
                (job,) = unit.jobs
                rank = ranks.setdefault(job.cell.name, len(ranks))
                job.directory.mkdir(parents=True, exist_ok=True)
                done = len(store.read_jsonl(job.directory / "log.jsonl")) if rank in looked else 0
                looked.add(rank)
                line = {"iteration": done + 1, "steps": done + 1, "success": 1 / (1 + rank)}
                store.append_line(job.directory / "log.jsonl", json.dumps(line))
                if done == 3 and not job.beside("drop").exists():
                    good(unit)
                if done == 3 or job.beside("drop").exists():
                    self.queue.remove(unit)
                    return [Ended(unit, None)]
            return []

    pytest.importorskip("optuna")
    from marlyap.sweeps.search import Searched

    looked: set[int] = set()
    fixed = {k: v for k, v in FIXED.items() if k not in SEARCH.ranges}
    sweep = go.make_sweep(Plan(fixed=fixed, search=SEARCH), tmp_path / "q")
    *_, last = drive(sweep, Slow(None), Searched(sweep), Launch())
    states = {s.job.cell.name: s.state for s in last}
    assert [states[name] for name in ranks][:4] == ["finished"] * 4
    assert "dropped" in states.values() and {*states.values()} == {"finished", "dropped"}
