"""A long take with Ray: chunks are tasks, an odd one waits for its two neighbours alone. All nodes see the folders.

    python ray_take.py CAPTURE RUN [options of `splat4d train`]

SPLAT4D names the command, CORES the processor cores of a task (default 1). On a cluster: RAY_ADDRESS=auto. Run it again after
whatever went wrong: what is done is not done twice.
"""

import json
import os
import subprocess
import sys

import ray

SPLAT4D = os.environ.get("SPLAT4D", "splat4d")
CORES = int(os.environ.get("CORES", "1"))


@ray.remote(num_cpus=CORES, max_retries=3, retry_exceptions=True)
def chunk(capture, run, part, options, *after):
    """Does one part; `after` is what it waits for."""
    threads = {"RAYON_NUM_THREADS": str(CORES)}
    command = [SPLAT4D, "train", capture, "-o", run, "--chunk", str(part), *options]
    subprocess.run(command, check=True, env={**os.environ, **threads})
    return part


def main(capture, run, *options):
    capture, run = os.path.abspath(capture), os.path.abspath(run)
    ray.init()
    ray.get(chunk.remote(capture, run, "shared", options))
    with open(os.path.join(run, "chunks", "plan.json")) as file:
        count = len(json.load(file)["cuts"]) + 1
    even = {c: chunk.remote(capture, run, c, options) for c in range(0, count, 2)}
    odd = [
        chunk.remote(capture, run, c, options, *(even[n] for n in (c - 1, c + 1) if n in even))
        for c in range(1, count, 2)
    ]
    ray.get([*even.values(), *odd])
    subprocess.run([SPLAT4D, "join", run], check=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
