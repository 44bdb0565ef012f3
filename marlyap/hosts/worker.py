"""Some copies in a process of their own: `python -m marlyap.hosts.worker`, started by `Workers`.

The first line of its standard input is a JSON object: source, arguments, first copy, how many. It
answers with a line of JSON, the sizes of the game or a refusal. Then each order is one byte and
what belongs to it, and each answer one byte and a row of numbers, or a line of JSON.
"""

import json
import os
import sys
from typing import IO

import numpy as np

from marlyap.errors import UserError
from marlyap.hosts.copies import SideBySide
from marlyap.hosts.sources import maker


RESET, STEP, ROW, REFUSED = b"r", b"s", b".", b"!"


def main() -> None:
    orders, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what an environment prints is no answer
    job = json.loads(orders.readline())
    try:
        make = maker(job["source"], job["arguments"])
        game = SideBySide(make, job["copies"], job["first"])
    except UserError as error:
        answers.write(json.dumps({"refused": str(error)}).encode() + b"\n")
        return
    answers.write(json.dumps({"spec": game.spec}).encode() + b"\n")
    serve(game, orders, answers)


def serve(game: SideBySide, orders: IO[bytes], answers: IO[bytes]) -> None:
    """Do what is ordered until the orders end."""
    copies, spec = game.copies, game.spec
    size = copies * spec.agents * spec.du * 4
    while order := orders.read(1):
        if order == RESET:
            seed, *episodes = np.frombuffer(orders.read(8 * (1 + copies)), np.int64).tolist()
            rows = game.begin(seed, episodes)
        else:
            action = np.frombuffer(orders.read(size), np.float32)
            rows = game.each(action.reshape(copies, spec.agents, spec.du))
        try:
            for row in rows:
                answers.write(ROW + row.tobytes())
        except UserError as error:
            answers.write(REFUSED + json.dumps(str(error)).encode() + b"\n")
            return


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:
        pass
    sys.stderr.flush()
    os._exit(0)  # environments leave threads behind
