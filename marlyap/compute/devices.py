"""Several devices: runs side by side on some, the episodes of each run shared out over the others.

All is said to XLA by shardings over one mesh with the axes RUNS and EPISODES, and it divides the
work. With one device there is no mesh, and nothing here does anything.
"""

import contextlib
import math
from typing import TypeVar

import equinox as eqx
import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from marlyap.types import Keys


RUNS, EPISODES = "runs", "episodes"
Tree = TypeVar("Tree")


def mesh_for(runs: int) -> Mesh | None:
    """As many devices for the runs as go into their number, the others for each run's episodes."""
    devices = jax.devices()
    if len(devices) == 1:
        return None
    side = math.gcd(runs, len(devices))
    shape, kinds = (side, len(devices) // side), (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh(shape, (RUNS, EPISODES), kinds, devices=devices)


def using(mesh: Mesh | None) -> contextlib.AbstractContextManager[object]:
    """Compile and run on the devices of the mesh."""
    return contextlib.nullcontext() if mesh is None else jax.set_mesh(mesh)


def placed(tree: Tree, several: bool, mesh: Mesh | None) -> Tree:
    """The arrays on the devices: each run's on its own, by their leading axis if `several`."""
    if mesh is None:
        return tree
    where = NamedSharding(mesh, _spec(several))
    return jax.tree.map(lambda x: jax.device_put(x, where) if eqx.is_array(x) else x, tree)


def kept(tree: Tree, several: bool) -> Tree:
    """Inside a compiled function: what it returns stays where `placed` put it."""
    return _constrained(tree, _spec(several))


def shard(keys: Keys) -> Keys:
    """Inside a compiled function: share out what is played with these keys over a run's devices."""
    return _constrained(keys, PartitionSpec(EPISODES))


def gathered(tree: Tree) -> Tree:
    """Inside a compiled function: all that a run's devices have played, on each of them."""
    return _constrained(tree, PartitionSpec())


def _spec(several: bool) -> PartitionSpec:
    return PartitionSpec(RUNS) if several else PartitionSpec()


def _constrained(tree: Tree, spec: PartitionSpec) -> Tree:
    if RUNS not in jax.sharding.get_abstract_mesh().axis_names:
        return tree
    hold = lambda x: jax.lax.with_sharding_constraint(x, spec) if eqx.is_array(x) else x
    return jax.tree.map(hold, tree)
