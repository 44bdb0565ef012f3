"""BenchMARL's MASAC, one iteration for every line on standard input; run by peer.py.

Runs in an environment of its own: nothing of marlyap is imported here.
usage: peer_benchmarl.py AGENTS FRAMES ENVIRONMENTS HORIZON
"""

import contextlib
import json
import sys
import tempfile
import time

import benchmarl
import torch
import torchrl
from benchmarl.algorithms import MasacConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig


def experiment(agents, frames, environments, horizon):
    """Our sizes and ratio: FRAMES steps and as many updates in an iteration."""
    torch.set_num_threads(1)
    c = ExperimentConfig.get_from_yaml()
    c.sampling_device = c.train_device = c.buffer_device = "cpu"
    c.share_policy_params = False
    c.prefer_continuous_actions = True
    c.gamma, c.lr, c.polyak_tau = 0.95, 3e-4, 0.005
    c.off_policy_collected_frames_per_batch = frames
    c.off_policy_n_envs_per_worker = environments
    c.off_policy_n_optimizer_steps = frames
    c.off_policy_train_batch_size = 256
    c.off_policy_memory_size = 100_000
    c.off_policy_init_random_frames = 0
    c.max_n_iters, c.max_n_frames = 10_000, None
    c.evaluation, c.render, c.loggers, c.create_json = False, False, [], False
    c.save_folder, c.checkpoint_interval = tempfile.mkdtemp(), 0
    task = VmasTask.SIMPLE_SPREAD.get_from_yaml()
    task.config |= {"max_steps": horizon, "n_agents": agents}
    net = MlpConfig(num_cells=[64, 64], activation_class=torch.nn.ReLU, layer_class=torch.nn.Linear)
    masac = MasacConfig.get_from_yaml()
    return Experiment(
        task=task,
        algorithm_config=masac,
        model_config=net,
        critic_model_config=net,
        seed=0,
        config=c,
    )


def main() -> None:
    agents, frames, environments, horizon = map(int, sys.argv[1:5])
    answers = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        it = experiment(agents, frames, environments, horizon)
        log, before = it.logger.log, [None]

        def tell(entries, step=None):
            """Called by the experiment once an iteration, with its own timers."""
            timers = ("timers/collection_time", "timers/training_time")
            if all(t in entries for t in timers):
                cpu = time.process_time() - before[0]
                wall = sum(entries[t] for t in timers)
                versions = {"benchmarl": benchmarl.__version__, "torch": torch.__version__}
                versions["torchrl"] = torchrl.__version__
                answer = {"wall": wall, "training": entries[timers[1]], "cpu": cpu}
                print(json.dumps(answer | {"versions": versions}), file=answers, flush=True)
                wait()
            return log(entries, step=step)

        def wait():
            if not sys.stdin.readline():
                raise SystemExit(0)
            before[0] = time.process_time()

        it.logger.log = tell
        wait()
        it.run()


main()
