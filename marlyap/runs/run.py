"""A run: one directory that says what it is and holds all that is needed to resume it.

run.json        task, algorithm, schedule, seed, versions: enough to repeat it
log.jsonl       one line an iteration
log.csv, events.out.tfevents.*   the same for spreadsheets and for TensorBoard; not read back
checkpoints/    the whole learner, replay memory and random keys included; the last two
policy/         the best policy so far, and the Lyapunov function: what is evaluated and deployed
"""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import singledispatch
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from marlyap import seeds
from marlyap.compute import export_cache
from marlyap.conformance import shapes
from marlyap.errors import UserError, defined_at
from marlyap.games.game import AbstractGame
from marlyap.hosts.sources import is_file, names_a_host
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.health import Health
from marlyap.learning.hosted import Hosted, HostPolicy
from marlyap.learning.schedule import Schedule
from marlyap.learning.source import shape
from marlyap.learning.traced import with_arrays
from marlyap.learning.trainers import trainer_for
from marlyap.learning.training import AbstractTrainer, Carry
from marlyap.nets.nets import LyapunovNet, NormNet
from marlyap.runs import config
from marlyap.runs.curves import columns, framed
from marlyap.runs.sinks import About, Sinks
from marlyap.simulation.rollout import Decentralised, Policy
from marlyap.storage import store


SCHEMA = 2


@dataclass(frozen=True)
class Run:
    """One training run on disk. Make it with `create` or `open`."""

    directory: Path
    trainer: AbstractTrainer
    seed: int
    names: dict[str, str]  # what the task and the algorithm were called
    warnings: tuple[str, ...] = ()  # what to tell whoever opens it

    @classmethod
    def create(
        cls,
        directory: Path | str,
        trainer: AbstractTrainer,
        seed: int,
        names: dict[str, str],
        force: bool = False,
    ) -> "Run":
        """A new run directory.

        Raises UserError if it exists, unless `force` empties it, or if the task returns a wrong
        shape.
        """
        directory = Path(directory)
        sound(trainer.game)
        cls.vacant(directory, force)
        if directory.exists():
            with store.lock(directory):  # not while another process trains in it
                shutil.rmtree(directory)
        parts = {"task": trainer.game, "algorithm": trainer.algorithm}
        made_of = {k: config.code_of(part, names.get(k, "")) for k, part in parts.items()}
        wanted = ("file", "sha256", "classes")  # of the user's own code alone
        code = {k: {w: found[w] for w in wanted} for k, found in made_of.items() if found}
        about = {
            "schema": SCHEMA,
            "task": config.record(trainer.game),
            "algorithm": config.record(trainer.algorithm),
            "schedule": config.record(trainer.schedule),
            "seed": seed,
            "names": names,
            "code": code,
            "entries": {
                kind: [entry._asdict() for entry in found]
                for kind, found in trainer.game.entries().items()
            },
            "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "versions": store.versions(),
        }
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"out: {directory} cannot be made ({error.strerror}).") from None
        store.write_text_atomic(directory / "run.json", json.dumps(about, indent=1) + "\n")
        return cls(directory, trainer, seed, names)

    @staticmethod
    def vacant(directory: Path, force: bool = False) -> None:
        """Raise UserError unless a run can be made here (with `force`, in place of another)."""
        Run.outside(directory)
        try:
            if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
                return
        except OSError as error:
            raise UserError(f"out: {directory} cannot be made ({error.strerror}).") from None
        if not force:
            raise UserError(
                f"out: {directory} already exists; choose another directory, resume it with "
                f"--resume {directory}, or overwrite it with --force."
            )
        if not (directory / "run.json").is_file():
            raise UserError(f"out: {directory} is not a run; --force would destroy it.")

    @staticmethod
    def outside(directory: Path) -> None:
        """Raise UserError if this is inside another run's directory."""
        for above in directory.resolve().parents:
            with suppress(OSError):
                if (above / "run.json").is_file():
                    raise UserError(
                        f"out: {directory} is inside the run {above}; choose another directory."
                    )

    @classmethod
    def open(
        cls,
        directory: Path | str,
        game: AbstractGame | Hosted | None = None,
        algorithm: AbstractAlgorithm | None = None,
    ) -> "Run":
        """A run that exists; pass the task or algorithm if it is code of your own.

        Raises UserError if the directory is not a run, or was changed, or is from a newer version.
        """
        directory = Path(directory)
        if not (directory / "run.json").is_file():
            raise UserError(f"run: {directory} is not a run (it has no run.json).")
        about = store.read_json(directory / "run.json")
        where = str(directory / "run.json")
        wanted = {"schema", "task", "algorithm", "schedule", "seed", "names"}
        if not isinstance(about, dict) or not wanted <= about.keys():
            raise UserError(f"run: {where} lacks some of its fields; use another copy of this run.")
        if about["schema"] != SCHEMA:
            raise UserError(
                f"run: {where} has schema {about['schema']}, this marlyap reads {SCHEMA}; train it "
                "again, or open it with the marlyap that made it."
            )
        if type(about["seed"]) is not int or not isinstance(about["names"], dict):
            raise UserError(f"run: {where} has a seed or names of the wrong kind.")
        seeds.check(about["seed"])
        names = {k: str(about["names"].get(k, "")) for k in ("task", "algorithm", "preset")}
        named = {"task": config.named_by(game), "algorithm": config.named_by(algorithm)}
        everything = named["algorithm"] | named["task"]
        parts, warnings = [], []
        for part in ("task", "algorithm", "schedule"):
            own, typed = everything | named.get(part, {}), names.get(part, "")
            code = _recorded(about.get("code"), part, where, own)
            allowed = {k: v for k, v in config.known().items() if k not in code["classes"]}
            allowed |= {k: v for k, v in own.items() if k in code["classes"]}
            try:
                made = config.build(about[part], allowed, part)
            except config.UnknownCode as error:
                file = typed if ":" in typed else f"path/to/file.py:{about[part]['kind']}"
                what = str(error).partition("; ")[0]
                raise UserError(
                    f"{what}; if it is your own code, name it with --{part} {file}."
                ) from None
            now = config.code_of(made, typed)
            if now and code["sha256"] not in (None, now["sha256"]):
                what = f"the code in {now['source']} is not what {directory} was trained with"
                warnings.append(f"{part}: {what}; it has changed since.")
            parts.append(made)
        families = (AbstractGame | Hosted, AbstractAlgorithm, Schedule)
        for part, family in zip(parts, families, strict=True):
            if not isinstance(part, family):
                raise UserError(f"run: {where} has a {type(part).__name__} in the wrong place.")
        permitted(parts[0], game)
        return cls(directory, trainer_for(*parts), about["seed"], names, tuple(warnings))

    @property
    def untouched(self) -> bool:
        """Whether training has left nothing here yet."""
        log = self.directory / "log.jsonl"
        return not self.checkpoints.steps() and not (log.exists() and log.stat().st_size)

    @property
    def game(self) -> AbstractGame:
        """In JAX. Raises UserError where it is played outside."""
        return self.trainer.model()

    @property
    def named(self) -> tuple[str, int]:
        """Directory and seed: how an event names its run."""
        return str(self.directory), self.seed

    @property
    def labels(self) -> dict[str, str]:
        """`names` to be shown: of path/to/file.py:Name the Name alone."""
        short = lambda name: name if names_a_host(name) else name.rpartition(":")[2]
        return {part: short(name) for part, name in self.names.items()}

    @property
    def title(self) -> str:
        named = [self.labels[k] for k in ("task", "algorithm") if k in self.names]
        return " ".join([*named, f"seed {self.seed}"])

    @property
    def checkpoints(self) -> store.Checkpoints:
        return store.Checkpoints(self.directory / "checkpoints")

    @property
    def steps_done(self) -> int:
        """Environment steps in the newest checkpoint's name; 0 before the first."""
        steps = self.checkpoints.steps()
        return max(steps) * self.trainer.steps_per_iteration if steps else 0

    @property
    def finished(self) -> bool:
        return self.steps_done >= self.trainer.iterations * self.trainer.steps_per_iteration

    def save(self, carry: Carry, seconds: float) -> None:
        """Checkpoint everything, and store the best policy with its Lyapunov function."""
        self.checkpoints.save(int(carry.iteration), flatten(carry), {"seconds": seconds})
        a = self.trainer.algorithm
        deployed = (carry.best, a.lyapunov(a.networks(carry.learner)))
        meta = {"seed": self.seed, "iteration": int(carry.iteration), "score": float(carry.score)}
        store.write(self.directory / "policy", "policy", flatten(deployed), meta, replace=True)

    def load(self) -> tuple[Carry, float, tuple[str, ...]]:
        """The newest sound checkpoint, the seconds spent until then, and warnings."""
        if not self.checkpoints.steps():
            return begin(self.trainer, self.seed), 0.0, ()
        saved = self.checkpoints.latest()
        like, _ = eqx.filter_eval_shape(self.trainer.begin, jax.random.key(0))
        carry = unflatten(like, saved.arrays, str(self.directory))
        warnings = (*saved.warnings, *self.trainer.resumed())
        return carry, float(saved.meta.get("seconds", 0.0)), warnings

    def lengthened(self, steps: int) -> "Run":
        """The same run with a schedule of so many environment steps, to be resumed.

        From here on the learning rates are those of the longer schedule at this place.
        Raises UserError if it is not longer than what has been done.
        """
        if steps <= self.steps_done:
            raise UserError(
                f"steps: {self.directory} has done {self.steps_done} already; take more."
            )
        schedule = dataclasses.replace(self.trainer.schedule, steps=steps)
        longer = dataclasses.replace(self.trainer, schedule=schedule)
        with store.lock(self.directory):
            if self.checkpoints.steps():
                carry, seconds, _ = self.load()
                like, _ = eqx.filter_eval_shape(longer.begin, jax.random.key(0))
                learner = longer.algorithm.with_room(carry.learner, like.learner)
                carry = eqx.tree_at(lambda c: c.learner, carry, learner)
                saved = {"seconds": seconds}
                self.checkpoints.save(int(carry.iteration), flatten(carry), saved)
            about = store.read_json(self.directory / "run.json")
            about["schedule"] = config.record(schedule)
            text = json.dumps(about, indent=1) + "\n"
            store.write_text_atomic(self.directory / "run.json", text)
        return dataclasses.replace(self, trainer=longer)

    def started_from(self, other: "Run") -> None:
        """Begin with the networks of another run, their optimisers and its policy; memory is fresh.

        Raises UserError where they do not fit.
        """
        a, carry = self.trainer.algorithm, begin(self.trainer, self.seed)
        learnt = other.trainer.algorithm.networks(other.load()[0].learner)
        networks = unflatten(a.networks(carry.learner), flatten(learnt), str(other.directory))
        learner = a.with_networks(carry.learner, networks)
        where = lambda c: (c.learner, c.best)
        self.save(eqx.tree_at(where, carry, (learner, a.policy(networks))), 0.0)

    def deployed(self) -> tuple[Policy, LyapunovNet | NormNet | None]:
        """The policy that this run deploys, and its Lyapunov function if it has one."""
        place = self.directory / "policy"
        if not place.is_dir():
            raise UserError(f"run: {self.directory} has no policy yet; train it first.")
        arrays, _ = store.read(place, "policy")
        a = self.trainer.algorithm

        def made(key):
            networks = a.init(self.trainer.shape, key)
            return a.policy(networks), a.lyapunov(networks)

        like = eqx.filter_eval_shape(made, jax.random.key(0))
        return unflatten(like, arrays, str(place))

    def controller(self, game: AbstractGame | None = None) -> Decentralised:
        """The policy as a controller of this run's game, or of another that it fits.

        Raises UserError if it takes other observations, or has other agents' weights.
        """
        there = self.game if game is None else game
        policy = self.deployed()[0]
        if game is not None and not _fits(policy, game):
            was, new = shape(self.game), shape(game)
            raise UserError(
                f"task: a policy of {was.agents} agents that observe {was.obs} numbers each does "
                f"not fit {new.agents} agents that observe {new.obs}; any number of agents needs "
                "shared weights (--algorithm.shared true) and room for as many neighbours always "
                "(--task.graph complete/8)."
            )
        return Decentralised(policy, there)

    def log(self, line: dict[str, Any]) -> dict[str, Any]:
        """One line an iteration; numbers that are not finite are left out. Returns what is kept."""
        sound = {k: v for k, v in line.items() if not isinstance(v, float) or np.isfinite(v)}
        store.append_line(self.directory / "log.jsonl", json.dumps(sound))
        return sound

    def sinks(self, names: Iterable[str] = ()) -> Sinks:
        """Where the log is told as well, with all that it holds: log.csv, TensorBoard, these."""
        made = {"task": self.trainer.game, "algorithm": self.trainer.algorithm}
        made |= {"schedule": self.trainer.schedule}
        about = About(
            self.directory,
            self.title,
            {k: config.record(v) for k, v in made.items()} | {"seed": self.seed},
        )
        return Sinks(about, self.history(), names)

    def curves(self) -> Any:
        """The log in columns, one row an iteration; what an iteration has not is NaN.

        A pandas DataFrame where pandas is there, else a dict of NumPy arrays.
        """
        return framed(columns(self.history()))

    def history(self) -> list[dict[str, Any]]:
        path = self.directory / "log.jsonl"
        lines = store.read_jsonl(path) if path.is_file() else []
        return [line for line in lines if isinstance(line, dict)]

    def rewind(self, iteration: int) -> None:
        """Forget what the log says of iterations that will be done again."""
        kept = [line for line in self.history() if line.get("iteration", 0) <= iteration]
        text = "".join(json.dumps(line) + "\n" for line in kept)
        store.write_text_atomic(self.directory / "log.jsonl", text)


def load_policy(
    directory: Path | str, task: AbstractGame | str | None = None
) -> Decentralised | HostPolicy:
    """The policy that a run deploys, ready to act.

    Arguments: directory, of the run; task, the run's task where it is code of your own: the object,
    or path/to/file.py:Name, which is executed.

    `load_policy(...).agent(i, obs)` is what agent i does at its own observation [obs] alone:
    numbers in [-1, 1]; times `game.plant.limits` they are inputs in their units.
    `load_policy(...).policy(obs, key)` takes what all agents observe [agent, obs] and gives actions
    [agent, input]. Row i follows from row i alone, and what `obs` holds is told by
    `game.entries()`. Called with a State and a key it is a controller of the run's game; the policy
    of a game outside JAX is called with what all agents observe.
    Raises UserError if the directory is no run, has no policy yet, or needs `task`.
    """
    game = config.load_task(task) if isinstance(task, str) else task
    run = Run.open(directory, game)
    return acting(run.trainer.game, run)


@singledispatch
def acting(game: AbstractGame, run: Run) -> Decentralised | HostPolicy:
    """The run's policy as what acts in this kind of game."""
    return run.controller()


@acting.register
def _(game: Hosted, run: Run) -> Decentralised | HostPolicy:
    return HostPolicy(run.deployed()[0], game)


def _recorded(code: Any, part: str, where: str, own: Iterable[str]) -> dict[str, Any]:
    """What run.json says of the user's code in one part; old ones say nothing, all is `own`."""
    if code is None:
        return {"sha256": None, "classes": list(own)}
    match code.get(part, {"sha256": None, "classes": []}) if isinstance(code, dict) else None:
        case {"sha256": str() | None, "classes": [*classes]} as found:
            if all(isinstance(name, str) for name in classes):
                return found
    raise UserError(f"run: {where} has a 'code' of the wrong kind; use another copy of this run.")


def _fits(policy: Policy, game: AbstractGame) -> bool:
    """Whether the policy takes the game's observations and acts for all of its agents."""
    act = lambda key: policy(game.observations(game.reset(key)), key)
    try:
        action = eqx.filter_eval_shape(act, jax.random.key(0))
    except (TypeError, ValueError):
        return False
    return action.shape == (game.agents, game.du)


def begin(trainer: AbstractTrainer, seed: int) -> Carry:
    """The state of a fresh run. Raises UserError if what it began with was not played in numbers.

    In numbers: all are finite, and no cost is negative.
    """
    key = seeds.stream(seed, "train")
    like = lambda: eqx.filter_eval_shape(trainer.begin, key)[0]
    carry, health = export_cache.compiled(_begin, with_arrays(trainer), key, like)(key)
    if fault := Health(**health).by_task(trainer.agents):
        when = f"in the warm-up (seed {seed})"
        raise UserError(f"{fault.says(when)} (check-task says more).")
    return carry


def _begin(trainer: AbstractTrainer, key: jax.Array) -> tuple[Carry, dict[str, Any]]:
    carry, health = trainer.begin(key)
    return carry, health._asdict()


@singledispatch
def permitted(game: AbstractGame | Hosted, given: AbstractGame | Hosted | None) -> None:
    """Raise UserError where the game is a file that the user has not named.

    What run.json says of code is never executed by itself.
    """


@permitted.register
def _(game: Hosted, given: AbstractGame | Hosted | None) -> None:
    named = given.source if isinstance(given, Hosted) else None
    if is_file(game.source) and named != game.source:
        raise UserError(
            f"task: it is played by code of your own; name it with --task {game.source}."
        )


@singledispatch
def sound(game: AbstractGame) -> None:
    """Raise UserError for what a task returns in a wrong shape or type, or where it raises.

    Shapes alone are computed. `marlyap check-task` says more.
    """
    for fault in shapes(game):
        place = defined_at(game, fault.partition(":")[0]) if " it raised " not in fault else None
        raise UserError(f"task: {f'{place}: ' if place else ''}{fault}")


@sound.register
def _(game: Hosted) -> None:
    """Its sizes were read when it was opened, and each number is checked when it comes."""


def expand(paths: Iterable[Path | str]) -> list[Path]:
    """Run directories: those given, and those one level below the others.

    Raises UserError where there is none, or one is given twice.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        here = [path] if (path / "run.json").exists() else sorted(path.glob("*/run.json"))
        if not here:
            raise UserError(f"run: {path} is not a run and holds none.")
        found += [p.parent if p.name == "run.json" else p for p in here]
    if len({p.resolve() for p in found}) != len(found):
        raise UserError("run: the same run is given twice.")
    return found


def flatten(tree: PyTree) -> dict[str, np.ndarray]:
    """The arrays of a tree by their path; random keys as their bits."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(tree, eqx.is_array))
    return {jax.tree_util.keystr(path): np.asarray(_bits(leaf)) for path, leaf in leaves}


def unflatten(like: PyTree, arrays: dict[str, np.ndarray], source: str) -> Any:
    """The tree shaped as `like`, with these arrays in it.

    Raises UserError naming the first array that is missing, superfluous or of another shape.
    """
    is_array = lambda x: isinstance(x, jax.Array | jax.ShapeDtypeStruct | np.ndarray)
    dynamic, static = eqx.partition(like, is_array)
    leaves, treedef = jax.tree_util.tree_flatten_with_path(dynamic)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    bits = [jax.eval_shape(_bits, leaf) for _, leaf in leaves]
    store.expect(arrays, dict(zip(names, bits, strict=True)), source)
    values = [
        _from_bits(jnp.array(arrays[name]), leaf.dtype)
        for name, (_, leaf) in zip(names, leaves, strict=True)
    ]
    return eqx.combine(treedef.unflatten(values), static)


def _bits(leaf: jax.Array) -> jax.Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _from_bits(value: jax.Array, dtype: Any) -> jax.Array:
    return jax.random.wrap_key_data(value) if jnp.issubdtype(dtype, jax.dtypes.prng_key) else value


def one_run(word: Path | str) -> Path:
    """The one run at this place. Raises UserError where there is none, or several."""
    found = expand([Path(word)])
    if len(found) > 1:
        raise UserError(f"run: {word} holds {len(found)} runs; name one, such as {found[0]}.")
    return found[0]
