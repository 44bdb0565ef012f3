"""Four devices (of a CPU's own making) do what one does, each its share."""

import json
import os
import subprocess
import sys


SHARES = """
import json, sys
from pathlib import Path
import jax, numpy as np
from jax.sharding import PartitionSpec as P
from conftest import keep_compiled_code
from marlyap import MASAC, Rendezvous, Schedule, Trainer
from marlyap.compute import devices
from marlyap.runs.events import Progress
from marlyap.runs.fit import fit
from marlyap.runs.run import Run, flatten

keep_compiled_code()
jax.config.update("jax_disable_most_optimizations", True)
assert len(jax.devices()) == 4

# The mesh: as many devices for the runs as go into their number.
sides = {n: list(devices.mesh_for(n).shape.values()) for n in (1, 2, 3, 4, 6, 8)}

# Keys are shared out where that can be done evenly, and not changed by it.
draw = lambda n: jax.vmap(jax.random.normal)(devices.shard(jax.random.split(jax.random.key(0), n)))
together = [np.asarray(jax.jit(draw, static_argnums=0)(n)) for n in (8, 7)]
with devices.using(devices.mesh_for(1)):
    apart = [jax.jit(draw, static_argnums=0)(n) for n in (8, 7)]
shared = [not x.sharding.is_fully_replicated for x in apart]
same = all(np.array_equal(a, np.asarray(b)) for a, b in zip(together, apart))

# One run is kept whole on every device; several by their leading axis.
tree = {"x": np.zeros((4, 3)), "n": 1.0, "k": jax.random.split(jax.random.key(0), 4)}
tree["x"] = jax.numpy.asarray(tree["x"])
whole = devices.placed(tree, False, devices.mesh_for(1))
parts = devices.placed(tree, True, devices.mesh_for(4))
kept = [whole["x"].sharding.is_fully_replicated, parts["x"].sharding.spec == P("runs"),
        parts["k"].sharding.spec == P("runs"), parts["n"] == 1.0]

# Two runs on two devices each, against two runs on one device.
algorithm = MASAC(batch=8, actor_width=4, critic_width=4)
plan = Schedule(steps=16, environments=4, steps_per_update=4, warmup=8, select_every=1,
                select_episodes=4)
trainer = Trainer(Rendezvous(horizon=2), algorithm, plan)

def trained(folder):
    runs = [Run.create(folder / str(s), trainer, s, {}) for s in (0, 1)]
    log = [event for event in fit(runs) if isinstance(event, Progress)]
    policies = [flatten(run.deployed()) for run in runs]
    carries = [flatten(run.load()[0]) for run in runs]
    return log, policies, carries

four = trained(Path(sys.argv[1], "four"))
devices.mesh_for = lambda runs: None
one = trained(Path(sys.argv[1], "one"))
worst = 0.0
for a, b in zip(jax.tree.leaves(four[1:]), jax.tree.leaves(one[1:]), strict=True):
    if np.issubdtype(a.dtype, np.floating):
        worst = max(worst, float(np.max(np.abs(a - b), initial=0)))
    else:
        assert np.array_equal(a, b)
print(json.dumps({"sides": sides, "shared": shared, "same": same, "kept": kept, "worst": worst,
                  "lines": [len(four[0]), len(one[0])]}))
"""


def test_four_devices_do_what_one_does(tmp_path):
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu"}
    path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", SHARES, str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment | {"PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["sides"] == {
        "1": [1, 4],
        "2": [2, 2],
        "3": [1, 4],
        "4": [4, 1],
        "6": [2, 2],
        "8": [4, 1],
    }
    assert found["shared"] == [True, False] and found["same"]
    assert all(found["kept"])
    assert found["worst"] < 1e-4
    assert found["lines"] == [4, 4]
