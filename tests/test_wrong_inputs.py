"""Wrong inputs over all verbs: each gets one sentence and exit code 2, and nothing is lost.

Every case is what a person typed, and the word that the answer has to begin with or contain. The
command runs in this process; afterwards the directory holds what it held before, byte for byte.
"""

import hashlib
import json
import re
import shutil

import pytest

from marlyap.cli import main


SMALL = """--task.horizon 4 --steps 16 --schedule.environments 2 --schedule.steps_per_update 4
--schedule.warmup 8 --schedule.capacity 40 --schedule.select_episodes 2
--algorithm.actor_width 4 --algorithm.critic_width 4 --algorithm.batch 4"""
RUN, CERTIFICATE = "RUN", "CERTIFICATE"  # replaced by a small trained run and its certificate

TASKS = {  # broken tasks of one's own, by what is wrong with them
    "raises": "def costs(self, state, action):\n        raise ValueError('my bug')",
    "typo": "def costs(self, state, action):\n        return self.distanse(state)",
    "scalar_cost": "def costs(self, state, action):\n        return jnp.sum(self.distance(state))",
    "column_cost": "def costs(self, state, action):\n        return self.distance(state)[:, None]",
    "none_cost": "def costs(self, state, action):\n        return None",
    "python_if": (
        "def costs(self, state, action):\n        d = self.distance(state)\n"
        "        return d if d[0] > 1 else 2 * d"
    ),
    "numpy_inside": (
        "def costs(self, state, action):\n        return np.asarray(self.distance(state)) + 1"
    ),
    "dict_state": "def reset(self, key):\n        return {'x': 1}",
    "raising_reset": "def reset(self, key):\n        return 1 / 0",
    "short_obs": (
        "def observe(self, state, links):\n        return super().observe(state, links)[1:]"
    ),
    "integer_obs": (
        "def observe(self, state, links):\n        return super().observe(state, links).astype(int)"
    ),
    "old_observe": "def observe(self, state):\n        return self.local_view(state)",
    "python_bool": "def terminated(self, state):\n        return True",
    "shape_success": "def success(self, state):\n        return self.distance(state) < 1",
    "raising_step": "def step(self, state, action):\n        raise RuntimeError('no')",
    "other_state": (
        "def step(self, state, action):\n"
        "        return eqx.tree_at(lambda s: s.x, state, state.x[:, :3])"
    ),
    "untyped": "more = 2",
}
HEAD = (
    "import equinox as eqx\nimport jax.numpy as jnp\nimport numpy as np\n"
    "from marlyap import Rendezvous\n\n\nclass Own(Rendezvous):\n    "
)


def each(command, options, starts):
    """One case for every value of an option."""
    return [
        (f"{command} {option} {value}", starts) for option, values in options for value in values
    ]


TRAIN = "train rendezvous masac --out new"
CASES = [
    ("train", "train"),
    ("train rendezvous", "train"),
    ("train rendezvouz masac", "task"),
    ("train rendezvous masak", "algorithm"),
    ("train masac rendezvous", "task"),
    ("train rendezvous masac extra", "extra"),
    ("train file.py masac", "task"),
    ("train missing.py:Own masac", "task"),
    ("train good.py:Nope masac", "task"),
    ("train good.py masac", "task"),
    ("train syntax.py:Own masac", "task"),
    ("train imports.py:Own masac", "task"),
    ("train exits.py:Own masac", "task"),
    ("train text.txt:Own masac", "task"),
    ("train folder:Own masac", "task"),
    ("train :Own masac", "task"),
    ("train rendezvous good.py:Own", "algorithm"),
    ("train rendezvous missing.py:X", "algorithm"),
    *[(f"train {name}.py:Own masac --out new", "") for name in TASKS],
    *each(
        TRAIN, [("--task.agents", ["0", "-1", "1.5", "x", "5000", "nan", "''"])], "--task.agents"
    ),
    *each(TRAIN, [("--task.leaders", ["9", "0,0", "-1", "x", "''"])], "--task.leaders"),
    *each(
        TRAIN,
        [
            (
                "--task.graph",
                [
                    "foo",
                    "0-1",
                    "0-5,1-2",
                    "0-0",
                    "disk:-1",
                    "disk:x",
                    "complete/0",
                    "geometric:0",
                    "geometric:0.001",
                    "''",
                ],
            )
        ],
        "--task.graph",
    ),
    *each(TRAIN, [("--task.radius", ["0", "-1", "nan", "inf", "x"])], "--task.radius"),
    *each(TRAIN, [("--task.size", ["0", "-2", "nan", "1e9", "big"])], "--task.size"),
    *each(TRAIN, [("--task.dt", ["0", "-1", "20", "nan"])], "--task.dt"),
    *each(TRAIN, [("--task.horizon", ["0", "-4", "1.5", "1e9", "x"])], "--task.horizon"),
    *each(TRAIN, [("--task.headings", ["maybe", "2"])], "--task.headings"),
    *each(TRAIN, [("--task.rest_weight", ["-1", "nan", "x"])], "--task.rest_weight"),
    *each(TRAIN, [("--task.dynamics", ["boat", "3"])], "--task.dynamics"),
    *each(
        TRAIN,
        [("--task.dynamics.limits", ["1", "0,1", "-1,1", "a,b", "nan,1", "1,2,3"])],
        "--task.dynamics.limits",
    ),
    *each(TRAIN, [("--task.dynamics.integrator", ["heun", "0"])], "--task.dynamics.integrator"),
    *each(TRAIN, [("--task.nosuch", ["3"]), ("--task.agent", ["3"])], "--task."),
    *each(TRAIN, [("--task.dynamics.nosuch", ["1"]), ("--task.radius.x", ["1"])], "--task."),
    *each(TRAIN, [("--task.", ["3"])], "--task."),
    *each(TRAIN, [("--algorithm.rate_Q", ["-1", "x", "nan"])], "--algorithm.rate_Q"),
    *each(TRAIN, [("--algorithm.gamma", ["2", "-0.1", "inf"])], "--algorithm.gamma"),
    *each(TRAIN, [("--algorithm.batch", ["0", "-8", "2.5"])], "--algorithm.batch"),
    *each(TRAIN, [("--algorithm.tau", ["5", "-1"])], "--algorithm.tau"),
    *each(TRAIN, [("--algorithm.actor_width", ["0", "-1"])], "--algorithm.actor_width"),
    *each(TRAIN, [("--algorithm.critic", ["foo"])], "--algorithm.critic"),
    *each(TRAIN, [("--algorithm.shared", ["maybe"])], "--algorithm.shared"),
    *each(TRAIN, [("--algorithm.n_step", ["0", "-1"])], "--algorithm.n_step"),
    *each(TRAIN, [("--algorithm.constraint", ["foo", "3"])], "--algorithm.constraint"),
    *each(TRAIN, [("--algorithm.constraint.reading", ["hinge"])], "--algorithm.constraint"),
    *each(TRAIN, [("--algorithm.nosuch", ["1"])], "--algorithm."),
    *each(
        "train rendezvous masac-lyapunov --out new",
        [
            ("--algorithm.constraint.reading", ["foo", "score"]),
            ("--algorithm.constraint.horizon", ["0", "-1", "x"]),
            ("--algorithm.constraint.weight", ["-1", "x"]),
            ("--algorithm.constraint.floor", ["0", "-1"]),
            ("--algorithm.constraint.target", ["foo"]),
            ("--algorithm.constraint.function", ["norm", "foo"]),
            ("--algorithm.constraint.agents", ["7", "1,1", "-1"]),
            ("--algorithm.constraint.slope", ["x", "spectral"]),
            ("--algorithm.constraint.tau", ["0", "3"]),
        ],
        "--algorithm.constraint",
    ),
    *each(
        TRAIN,
        [
            ("--schedule.environments", ["0", "-3", "x", "1e9"]),
            ("--schedule.steps_per_update", ["0", "-1"]),
            ("--schedule.warmup", ["-1", "x"]),
            ("--schedule.capacity", ["0"]),
            ("--schedule.decay", ["0", "2", "nan"]),
            ("--schedule.select_every", ["0"]),
            ("--schedule.select_episodes", ["0"]),
            ("--schedule.nosuch", ["1"]),
        ],
        "--schedule.",
    ),
    *each(TRAIN, [("--steps", ["0", "-5", "abc", "nan", "1.5", "1e99"])], "steps"),
    *each(TRAIN, [("--seeds", ["x", "1.5", "-1", "0 0", "0,0", "2147483648"])], "seed"),
    *each(TRAIN, [("--preset", ["foo", "3"])], "preset"),
    *each(TRAIN, [("--device", ["tpu"])], "device"),
    *each(TRAIN, [("--parallel", ["foo"])], "parallel"),
    *each(TRAIN, [("--on-nan", ["foo"])], "on-nan"),
    (f"{TRAIN} --seeds 0 --seeds 1", "seeds"),
    (f"{TRAIN} --task.agents 3 --task.agents 4", "--task.agents"),
    (f"{TRAIN} --task.agents", "--task.agents"),
    (f"{TRAIN} --sed 0", "--sed"),
    (f"{TRAIN} --stepz 10", "--stepz"),
    ("train rendezvous masac --out", "--out"),
    ("train rendezvous masac --out file.txt", "out"),
    ("train rendezvous masac --out ''", "out"),
    ("train rendezvous masac --out RUN", "out"),
    ("train rendezvous masac --out RUN/inside", "out"),
    ("train rendezvous masac --out /proc/nope/deep", "out"),
    ("train --resume missing", "run"),
    ("train --resume kept", "run"),
    ("train --resume RUN --seeds 3", "--seeds"),
    ("train --resume RUN --steps 10", "steps: "),
    ("train --resume RUN --out new", "--out"),
    ("train --resume RUN --task.agents 4", "--task.agents"),
    ("train --resume RUN RUN", "run"),
    ("evaluate", "required: RUN"),
    ("evaluate missing", "run"),
    ("evaluate kept", "run"),
    ("evaluate file.txt", "run"),
    ("evaluate tree-pursuit", "task"),
    ("evaluate tree-pursui --task rendezvous", "run"),
    ("evaluate tree-pursuit --task rendezvouz", "task"),
    ("evaluate tree-pursuit --task rendezvous --task.dynamics double-integrator", "controller"),
    ("evaluate RUN RUN", "run"),
    ("evaluate RUN --task nope", "task"),
    ("evaluate RUN --task rendezvous-path5", "task"),
    ("evaluate RUN --task good.py", "task"),
    ("evaluate RUN --task.agents 5", "task"),
    ("evaluate RUN --task.dynamics late-unicycle", "task"),
    ("evaluate RUN --algorithm.gamma 0.9", "--algorithm.gamma"),
    ("evaluate RUN --schedule.steps 4", "--schedule.steps"),
    ("evaluate RUN --algorithm nope", "algorithm"),
    *each("evaluate RUN", [("--episodes", ["0", "-1", "x", "1.5", "99999999999"])], "episodes"),
    *each("evaluate RUN", [("--confidence", ["0", "1", "2", "-1", "x", "nan"])], "confidence"),
    *each("evaluate RUN", [("--seed", ["-1", "x", "1.5", "2147483648"])], "seed"),
    ("evaluate RUN --task.radius -1", "--task.radius"),
    ("evaluate RUN --out missing/deep/file.json --json", "out"),
    *[(f"evaluate broken/{i}", "run") for i in (0, 1, 2, 3, 4, 5, 6, 7, 11)],
    ("evaluate broken/8", "seed"),
    ("evaluate broken/9", "task"),
    ("evaluate broken/10", "run"),
    *[(f"evaluate policy/{i}", "policy") for i in range(5)],
    ("certify", "required: RUN"),
    ("certify missing", "run"),
    ("certify tree-pursuit", "task"),
    ("certify RUN --certificates nope --out c", "certificates"),
    ("certify RUN --certificates reach nope --out c", "certificates"),
    ("certify RUN --certificates closed-form --out c", "closed-form"),
    *each(
        "certify RUN --certificates reach --out c",
        [("--rollouts", ["0", "-5", "1", "x"])],
        "rollouts",
    ),
    *each("certify RUN --out c", [("--confidence", ["0", "1", "7", "x"])], "confidence"),
    *each("certify RUN --out c", [("--seed", ["-1", "x"])], "seed"),
    ("certify RUN --certificates reach --out kept", "out"),
    ("certify RUN --task nope --out c", "task"),
    ("certify RUN --task.agents 8 --out c", "task"),
    ("certify RUN --algorithm.gamma 0.9 --out c", "--algorithm.gamma"),
    ("recheck", "required: CERTIFICATE"),
    ("recheck missing", "missing"),
    ("recheck file.txt", "file.txt"),
    ("recheck RUN", "r/seed0"),
    ("recheck kept", "kept"),
    ("recheck CERTIFICATE --nope", "--nope"),
    *[(f"recheck forged/{i}", "") for i in range(6)],
    ("check-task", "task"),
    ("check-task nope", "task"),
    ("check-task missing.py:Own", "task"),
    ("check-task good.py", "task"),
    ("check-task rendezvous --seed -1", "seed"),
    ("check-task rendezvous --seed x", "seed"),
    ("check-task rendezvous --task.agents 0", "--task.agents"),
    ("check-task rendezvous --algorithm.gamma 0.9", "--algorithm.gamma"),
    ("report", "required: RUN"),
    ("report missing", "run"),
    ("report kept", "run"),
    ("report RUN RUN", "run"),
    ("report RUN --episodes 0", "episodes"),
    ("report RUN --seed -1", "seed"),
    ("report RUN --out missing/deep/r.html", "missing/deep"),
    ("report RUN --task nope", "task"),
    ("watch", "required: RUN"),
    ("watch missing", "run"),
    *each("watch RUN", [("--episode", ["-1", "500", "x"])], "episode"),
    ("watch RUN --seed -1", "seed"),
    ("watch RUN --out missing", "out"),
    ("watch RUN --task nope", "task"),
    ("list nope", "name"),
    ("list tree-pursui", "name"),
    ("list rendezvous masac", "masac"),
    ("demo --seeds x", "seeds"),
    ("demo --steps 0 --out new", "steps"),
    ("demo --out file.txt", "out"),
    ("demo --out RUN", "out"),
    ("nope", "nope"),
    ("evaluat RUN", "evaluat"),
    ("--nope", "--nope"),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A directory with a small run, its certificate, and all that can be wrong."""
    import os

    root = tmp_path_factory.mktemp("wrong")
    before = os.getcwd()
    os.chdir(root)
    assert main(["train", "rendezvous", "masac", "--out", "r", *SMALL.split()]) == 0
    run = root / "r" / "seed0"
    words = "certify r/seed0 --certificates reach --rollouts 800 --out certificate"
    assert main(words.split()) == 0
    for name, body in TASKS.items():
        (root / f"{name}.py").write_text(f"{HEAD}{body}\n")
    (root / "good.py").write_text(f"{HEAD}pass\n")
    (root / "syntax.py").write_text("class Own(:\n")
    (root / "imports.py").write_text("import nothing_of_that_name\n")
    (root / "exits.py").write_text("raise SystemExit(3)\n")
    (root / "text.txt").write_text("no Python")
    (root / "file.txt").write_text("a file")
    (root / "folder").mkdir()
    (root / "kept").mkdir()
    (root / "kept" / "thesis.tex").write_text("years of work")
    break_runs(root, run)
    forge(root)
    yield root
    os.chdir(before)


def break_runs(root, run):
    """Copies of the run with run.json or the policy damaged."""
    about = (run / "run.json").read_text()
    change = lambda **k: json.dumps(json.loads(about) | k)
    texts = [
        "",
        about[: len(about) // 2],
        "[]",
        "null",
        "{}",
        about.replace('"seed": 0', '"seed": NaN'),
        change(schema=99),
        change(seed="0"),
        change(seed=-1),
        change(task={"kind": "Boat"}),
        change(task=json.loads(about)["algorithm"]),
        change(names=3),
    ]
    for i, text in enumerate(texts):
        (root / "broken" / str(i)).mkdir(parents=True)
        (root / "broken" / str(i) / "run.json").write_text(text)
    for i in range(5):
        copy = root / "policy" / str(i)
        shutil.copytree(run, copy)
        arrays, manifest = copy / "policy" / "arrays.safetensors", copy / "policy" / "manifest.json"
        if i == 0:
            shutil.rmtree(copy / "policy")
        elif i == 1:
            arrays.write_bytes(arrays.read_bytes()[:100])
        elif i == 2:
            raw = bytearray(arrays.read_bytes())
            raw[-5] ^= 1
            arrays.write_bytes(bytes(raw))
        elif i == 3:
            manifest.unlink()
        else:
            manifest.write_text(manifest.read_text().replace('"score"', '"scone"'))


def forge(root):
    """Copies of the certificate, damaged or edited without its seal being made anew."""
    for i in range(6):
        copy = root / "forged" / str(i)
        shutil.copytree(root / "certificate", copy)
        manifest, arrays = copy / "manifest.json", copy / "arrays.safetensors"
        text = manifest.read_text()
        if i == 0:
            manifest.write_text(text.replace('"holds": false', '"holds": true', 1) + " ")
        elif i == 1:
            manifest.write_text(text[:200])
        elif i == 2:
            manifest.write_text("")
        elif i == 3:
            arrays.unlink()
        elif i == 4:
            (copy / "more.txt").write_text("more")
        else:
            manifest.write_text(re.sub(r'"bound": [\d.]+', '"bound": 0.99999', text))


def contents(root):
    """Every file below a directory and the hash of what is in it."""
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("*"))
        if p.is_file() and "__pycache__" not in p.parts and p.name != ".lock"
    }


def typed(command):
    """The words of a command, as a shell would split them."""
    import shlex

    names = {RUN: "r/seed0", CERTIFICATE: "certificate"}
    return [re.sub("^(RUN|CERTIFICATE)", lambda m: names[m[0]], w) for w in shlex.split(command)]


def test_there_are_two_hundred():
    commands = [command for command, _ in CASES]
    assert len(set(commands)) == len(commands) >= 200
    verbs = {command.split()[0] for command in commands}
    assert {"train", "evaluate", "certify", "recheck", "check-task", "report", "watch"} <= verbs


@pytest.mark.parametrize(("command", "names"), CASES, ids=[command for command, _ in CASES])
def test_a_wrong_input_is_answered_in_one_sentence(command, names, place, capsys):
    before = contents(place)
    code = main(typed(command))
    said = capsys.readouterr()
    lines = said.err.strip().splitlines()
    assert code == 2, said
    assert len(lines) == 1 and lines[0].startswith("marlyap: "), said.err
    assert names in lines[0]
    assert "Traceback" not in said.err and len(lines[0]) < 600
    assert lines[0].endswith((".", "?")) and not said.out.strip()
    assert contents(place) == before
    assert not (place / "new").exists() or not any((place / "new").rglob("*"))
