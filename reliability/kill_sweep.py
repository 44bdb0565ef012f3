"""A sweep whose processes are killed at random, against the same sweep left alone.

    python reliability/kill_sweep.py [--kills 30] [--on local] [--seed 0] [--out FILE]

Eight tiny jobs are driven by `marlyap sweep run` with two workers that save twice a second. Again
and again, after a random time, SIGKILL ends the driver, a worker with the training in it, all
workers, or driver and workers together (with `--on ray`, also the head of Ray); then the driver is
started again. A sweep that is done gives way to a fresh one until all kills are spent. Told are:
processes alive 5 s after their driver died, jobs that did not finish exactly once, rows that the
table lacks, and policies that differ from those of the sweep that was left alone.
"""

import argparse
import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path


ROOT = Path(__file__).parent.parent
PLAN = """
task = "rendezvous"
algorithm = "masac"
seeds = [0, 1]
[fixed]
"task.agents" = 2
"task.horizon" = 10
"schedule.steps" = 6_000
"schedule.environments" = 4
"schedule.steps_per_update" = 1
"schedule.warmup" = 100
"schedule.select_episodes" = 8
"algorithm.actor_width" = 8
"algorithm.critic_width" = 8
"algorithm.batch" = 32
[grid]
"algorithm.rate_Q" = [1e-3, 3e-3]
"algorithm.tau" = [0.005, 0.01]
"""
CHILD = """
import os
import marlyap.sweeps.worker as worker
prepare = worker.environment.prepare
def prepared(*given):
    prepare(*given)
    import marlyap.runs.fit as fit
    fit.PATIENCE, fit.SHARE = 0.5, 1e9
worker.environment.prepare = prepared
os._exit(worker.main())
"""
DRIVER = """
import sys
import marlyap.sweeps.engine as engine
engine.WORKER = (sys.executable, "-c", sys.argv[1])
from marlyap.cli import main
sys.exit(main(["sweep", "run", *sys.argv[2:]]))
"""
WORD = "MARLYAP_KILL_SWEEP"  # in the environment of all that a driver starts
GONE = 5.0  # seconds after the driver within which all must have ended
TARGETS = ("driver", "worker", "workers", "all")


def processes(token: str) -> dict[int, str]:
    """What carries the token: command lines by number; those that have ended are left out."""
    found = {}
    for place in Path("/proc").iterdir():
        try:
            if f"{WORD}={token}".encode() in (place / "environ").read_bytes():
                if (place / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                    line = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                    found[int(place.name)] = line
        except (OSError, ValueError):
            continue
    return found


def trainings(token: str) -> list[int]:
    """The processes that train."""
    return [pid for pid, line in processes(token).items() if CHILD in line]


def start(directory: Path, on: str, token: str) -> subprocess.Popen:
    words = [sys.executable, "-c", DRIVER, CHILD, str(directory), "--workers", "2", "--on", on]
    with open(directory.parent / "driver.log", "a") as log:
        return subprocess.Popen(
            words, cwd=ROOT, stdout=log, stderr=log, env=os.environ | {WORD: token}
        )


def strike(driver: subprocess.Popen, target: str, token: str, rng: random.Random) -> None:
    """Kill what the target says, as far as it is there."""
    children = sorted(pid for pid in trainings(token) if pid != driver.pid)
    victims = {"worker": children[:1] if rng.random() < 0.5 else children[-1:]}
    victims |= {"driver": [driver.pid], "workers": children, "all": [driver.pid, *children]}
    heads = [pid for pid, line in processes(token).items() if "gcs_server" in line]
    for pid in (victims | {"head": heads})[target]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


def orphans(token: str) -> list[str]:
    """Trainings that are alive GONE seconds after their driver."""
    until = time.monotonic() + GONE
    while time.monotonic() < until and trainings(token):
        time.sleep(0.1)
    return [str(pid) for pid in trainings(token)]


def results(directory: Path) -> dict[str, str]:
    """The policy of every job that has finished."""
    return {
        f"{path.parent.parent.name}/{path.parent.name}": json.loads(path.read_text())["policy"]
        for path in directory.glob("*/seed*/result.json")
    }


def judge(directory: Path, expected: dict[str, str], written: dict[str, float]) -> list[str]:
    """What is wrong with a sweep that is done."""
    faults, found = [], results(directory)
    for job, policy in expected.items():
        if found.get(job) != policy:
            faults.append(f"{job}: policy {found.get(job)} is not {policy}")
        log = (directory / job / "log.jsonl").read_text().splitlines()
        counts = Counter(json.loads(line)["iteration"] for line in log)
        if set(counts.values()) != {1} or max(counts) != len(counts):
            faults.append(f"{job}: its log has iterations twice or not at all")
        if job in written and written[job] != (directory / job / "result.json").stat().st_mtime:
            faults.append(f"{job}: it finished twice")
    with (directory / "table.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "finished"]
    if len(rows) != len(expected):
        faults.append(f"the table has {len(rows)} of {len(expected)} jobs")
    return faults


def make(directory: Path) -> None:
    shutil.rmtree(directory, ignore_errors=True)
    plan = directory.parent / "plan.toml"
    plan.write_text(PLAN)
    words = [sys.executable, "-m", "marlyap", "sweep", "make", str(plan), "--out", str(directory)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True)


class Campaign:
    """All kills of one engine, and what they did."""

    def __init__(self, place: Path, on: str, seed: int):
        self.place, self.on, self.rng = place / "sweep", on, random.Random(seed)
        self.kills, self.faults, self.sweeps = Counter[str](), list[str](), 0
        self.targets = (*TARGETS, "head") if on == "ray" else TARGETS
        self.slowest = 0.0  # seconds from the driver's death to its last training's

    def kill(self, most: float, token: str, written: dict[str, float]) -> bool:
        """Start the driver and kill after a while; True where the sweep was done before."""
        driver = start(self.place, self.on, token)
        try:
            driver.wait(self.rng.uniform(0.3, most))
            return True
        except subprocess.TimeoutExpired:
            pass
        target = self.rng.choice(self.targets)
        strike(driver, target, token, self.rng)
        self.kills[target] += 1
        if target in ("worker", "workers"):  # the driver goes on, for a while
            time.sleep(self.rng.uniform(0.0, 3.0))
            driver.kill()
        elif target == "head":
            driver.kill()
        driver.wait()
        died = time.monotonic()
        if left := orphans(token):
            self.faults.append(f"after {target}: {', '.join(left)} alive after {GONE} s")
        self.slowest = max(self.slowest, time.monotonic() - died)
        for path in self.place.glob("*/seed*/result.json"):
            name = f"{path.parent.parent.name}/{path.parent.name}"
            written.setdefault(name, path.stat().st_mtime)
        return False

    def sweep(self, kills: int, most: float, expected: dict[str, str]) -> None:
        """One sweep, killed until it is done or the kills are spent, then left alone."""
        make(self.place)
        written: dict[str, float] = {}
        while self.kills.total() < kills:
            if self.kill(most, f"{os.getpid()}-{self.kills.total()}", written):
                break
        start(self.place, self.on, "last").wait()
        self.sweeps += 1
        self.faults += judge(self.place, expected, written)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30, help="over all")
    parser.add_argument("--most", type=float, default=20.0, help="longest time to a kill (s)")
    parser.add_argument("--on", default="local", help="local or ray")
    parser.add_argument("--seed", type=int, default=0, help="of times and targets")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        campaign = Campaign(place, args.on, args.seed)
        make(campaign.place)
        start(campaign.place, "local", "reference").wait()
        expected = results(campaign.place)
        assert len(expected) == 8, (place / "driver.log").read_text()
        while campaign.kills.total() < args.kills:
            campaign.sweep(args.kills, args.most, expected)
            print(dict(campaign.kills), campaign.faults, flush=True)
    told = {
        "on": args.on,
        "kills": dict(campaign.kills),
        "sweeps": campaign.sweeps,
        "jobs": len(expected),
        "slowest_end_s": round(campaign.slowest, 2),
        "faults": campaign.faults,
    }
    print(json.dumps(told, indent=1))
    if args.out:
        args.out.write_text(json.dumps(told, indent=1) + "\n")
    return int(bool(campaign.faults))


if __name__ == "__main__":
    sys.exit(main())
