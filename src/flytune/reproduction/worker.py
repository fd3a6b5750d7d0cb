"""One training of a study in a process of its own: `python -m flytune.reproduction.worker '{...}'`.

It tells how far it is on standard output, one JSON object per line, and ends with the exit codes of the command line.
"""

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

from flytune.errors import FlytuneError

INTERVAL = 0.5  # s between two lines


def main(order: str) -> int:
    """The exit code of one training: 0 done, 2 bad input, 3 diverged, 130 interrupted."""
    from flytune.task.task import load_task
    from flytune.training.loop import Progress, train

    told = json.loads(order)
    spoken = 0.0

    def tell(progress: Progress) -> None:
        nonlocal spoken
        if progress.update == progress.updates or time.monotonic() - spoken > INTERVAL:
            spoken = time.monotonic()
            print(json.dumps(dataclasses.asdict(progress)), flush=True)

    try:
        out = Path(told["out"])
        train(
            load_task(told["task"]),
            told["trainer"],
            seed=told["seed"],
            out=out,
            resume=told["resume"],
            on_progress=tell,
        )
    except FlytuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # whoever asked is gone; the run goes on from its checkpoint next time
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
