"""Measures what docs/python.md states: `python crates/splat4d-py/tests/figures.py`, in an environment with the wheel."""

import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

# Times that a figure is measured: the median, and the least, which is more robust where others use the machine.
ROUNDS = 60
MANY = 150_000
KNIGHT = pathlib.Path(__file__).resolve().parents[3] / "examples/knight"


def told(times):
    return f"{1e3 * statistics.median(times):.1f} ms (least {1e3 * min(times):.1f})"


def measured(work):
    times = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return told(times)


clock = "import time; b = time.perf_counter(); import splat4d; print(time.perf_counter() - b)"
imports = [float(subprocess.check_output([sys.executable, "-c", clock])) for _ in range(ROUNDS)]
print(f"import splat4d: {told(imports)}")

import splat4d  # noqa: E402

with tempfile.TemporaryDirectory() as folder:
    settings = dict(iterations=50, downscale=8, max_frames=3, init="random", num_pts=MANY, max_cap=MANY, sh_degree=3)
    run = splat4d.train(KNIGHT, folder + "/run", motion="spacetime", life="infinite", densify__strategy="none", **settings)
    scene = run.scene()
    middle = sum(scene.clip) / 2
    now = scene.at(middle)
    print(f"at(t): {measured(lambda: scene.at(middle))}, {len(now)} of {len(scene)} Gaussians, all moving and turning")
    print(f"at(t).sh: {measured(lambda: scene.at(middle).sh)} with it, {now.sh.shape}")
    camera = scene.cameras[0][1]
    print(f"render: {measured(lambda: scene.render(camera, middle))}, {camera.width}x{camera.height}")
