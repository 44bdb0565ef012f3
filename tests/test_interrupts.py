"""Ctrl-C ends every verb with one line and exit code 130, whatever it is doing."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from marlyap.cli import entry, interrupts, main


TINY = """--task.horizon 4 --steps 16 --schedule.environments 2 --schedule.steps_per_update 4
--schedule.warmup 8 --schedule.capacity 40 --schedule.select_episodes 2
--algorithm.actor_width 4 --algorithm.critic_width 4 --algorithm.batch 4""".split()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("interrupts")
    assert main(["train", "rendezvous", "masac", "--out", str(out), *TINY]) == 0
    return out / "seed0"


WATCHED = """
from marlyap import cli
from marlyap.cli import interrupts
watch = interrupts.on_interrupt_exit
interrupts.on_interrupt_exit = lambda: (watch(), print("ready", flush=True))
cli.program()
"""


def interrupted(argv, seconds):
    """Exit code and standard error of a command sent SIGINT so many seconds after it begins.

    It begins when its handler stands: how long Python takes to start is the machine's affair.
    """
    command = [sys.executable, "-c", WATCHED, *map(str, argv)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None and child.stdout.readline() == "ready\n"
        time.sleep(seconds)
        child.send_signal(signal.SIGINT)
        sent = time.monotonic()
        _, said = child.communicate()
    return child.returncode, said, time.monotonic() - sent


def verbs(run, out):
    return {
        "evaluate": ["evaluate", run, "--episodes", "100000"],
        "certify": ["certify", run, "--rollouts", "100000", "--out", out / "certificate"],
        "check-task": ["check-task", "formation"],
        "report": ["report", run, "--episodes", "100000", "--out", out / "report.html"],
        "watch": ["watch", run, "--out", out],
        "list": ["list"],
        "demo": ["demo", "--out", out / "demo"],
        "train": ["train", "formation", "masac", "--out", out / "train"],
    }


def ends_in_one_line(argv, seconds):
    code, said, took = interrupted(argv, seconds)
    lines = said.strip().splitlines()
    assert code == 130 and "Traceback" not in said, (code, said)
    assert len(lines) == 1 and lines[0].startswith("marlyap: interrupted; "), said
    assert took < 10


@pytest.mark.parametrize(
    ("verb", "seconds"), [("evaluate", 0.3), ("train", 0.6), ("certify", 5.0), ("check-task", 3.0)]
)
def test_an_interrupt_is_one_line(run, tmp_path, verb, seconds):
    """While Python starts, JAX is imported, XLA compiles, and rollouts run."""
    ends_in_one_line(verbs(run, tmp_path)[verb], seconds)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.3, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
@pytest.mark.parametrize("verb", ["evaluate", "certify", "check-task", "report"])
def test_an_interrupt_at_any_moment_is_one_line(run, tmp_path, verb, seconds):
    argv = verbs(run, tmp_path)[verb]
    code, said, took = interrupted(argv, seconds)
    assert "Traceback" not in said and code in (0, 130) and took < 30, (code, said)
    assert code == 0 or "marlyap: interrupted" in said


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["watch", "list", "demo", "train"])
def test_every_verb_ends_in_one_line(run, tmp_path, verb):
    ends_in_one_line(verbs(run, tmp_path)[verb], 0.1)


def test_two_threads_that_are_told_say_it_once(capfd, monkeypatch):
    """Python's handler and the watching thread can both be told of one signal."""
    monkeypatch.setattr(interrupts, "ENDING", threading.Lock())
    monkeypatch.setattr(os, "_exit", lambda code: None)
    both = [threading.Thread(target=interrupts.exit_interrupted) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert capfd.readouterr().err.count("interrupted") == 1


def test_in_process_an_interrupt_is_a_code(monkeypatch, capfd):
    def stop(argv):
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, "command", stop)
    assert main(["list"]) == 130
    assert "marlyap: interrupted; " in capfd.readouterr().err


def test_an_interrupt_that_python_does_not_come_to_still_ends_it(tmp_path):
    """A thread is told of the signal while the main one is in one long call of C."""
    script = "from marlyap.cli.interrupts import on_interrupt_exit; on_interrupt_exit(); "
    script += "print('ready', flush=True); "
    script += "import hashlib; hashlib.pbkdf2_hmac('sha256', b'a', b'b', 2 * 10**7)"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None and child.stdout.readline() == "ready\n"
        time.sleep(0.2)
        os.kill(child.pid, signal.SIGINT)
        _, said = child.communicate()
    assert child.returncode == 130 and "nothing was written" in said


EARLY = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

for name in [n for n in sys.modules if n.partition('.')[0] in ('argparse', 'pathlib')]:
    del sys.modules[name]
sys.meta_path.insert(0, Interrupting())
from marlyap.cli import program
program()
"""


@pytest.mark.parametrize("module", ["argparse", "pathlib", "marlyap.cli.entry", "marlyap.errors"])
def test_an_interrupt_while_the_command_line_is_imported_is_one_line(module):
    """The handler stands before anything else is imported."""
    command = [sys.executable, "-c", EARLY, module]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 130, done.stderr
    assert done.stderr == "\nmarlyap: interrupted; nothing was written.\n"


def test_next_to_nothing_is_imported_before_the_handler_stands():
    script = "import importlib, signal, sys; before = {*sys.modules}; "
    script += "from marlyap.cli import program; print(*sorted({*sys.modules} - before))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "marlyap marlyap.cli\n", done
