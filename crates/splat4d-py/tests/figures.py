"""Measures what docs/python.md states: `python crates/splat4d-py/tests/figures.py`, in an environment with the wheel."""

import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

# Times that a figure is measured; the median counts.
ROUNDS = 15
MANY = 150_000
KNIGHT = pathlib.Path(__file__).resolve().parents[3] / "examples/knight"


def milliseconds(work):
    times = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times)


clock = "import time; b = time.perf_counter(); import splat4d; print(time.perf_counter() - b)"
imports = [float(subprocess.check_output([sys.executable, "-c", clock])) for _ in range(ROUNDS)]
print(f"import splat4d: {1e3 * statistics.median(imports):.1f} ms")

import splat4d  # noqa: E402

with tempfile.TemporaryDirectory() as folder:
    settings = dict(iterations=50, downscale=8, max_frames=3, init="random", num_pts=MANY, max_cap=MANY, sh_degree=3)
    run = splat4d.train(KNIGHT, folder + "/run", motion="spacetime", life="infinite", densify__strategy="none", **settings)
    scene = run.scene()
    middle = sum(scene.clip) / 2
    now = scene.at(middle)
    print(f"at(t): {milliseconds(lambda: scene.at(middle)):.1f} ms, {len(now)} of {len(scene)} Gaussians, all moving and turning")
    print(f"at(t).sh: {milliseconds(lambda: scene.at(middle).sh):.1f} ms with it, {now.sh.shape}")
    camera = scene.cameras[0][1]
    print(f"render: {milliseconds(lambda: scene.render(camera, middle)):.1f} ms, {camera.width}x{camera.height}")
