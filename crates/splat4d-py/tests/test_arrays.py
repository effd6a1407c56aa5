"""Arrays in: Gaussians and scenes of a program's own, files of them, gradients at any camera and time, own motion models."""

import unittest
import warnings

import numpy as np

import splat4d
from common import KNIGHT, SHORT, InFolder

BRIEF = {name: value for name, value in SHORT.items() if name != "motion"}


def cloud(count=40, seed=1):
    """Some Gaussians in front of the camera, as keyword arguments."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    return dict(
        means=random.uniform(-1, 1, (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=random.uniform(0.05, 0.2, (count, 3)),
        opacities=random.uniform(0.3, 0.9, count),
        sh=random.normal(0, 0.3, (count, 4, 3)),
    )


CAMERA = splat4d.Camera.look_at([0.3, 0.4, -4], [0, 0, 0], [0, 1, 0], width=32, height=24)


class Arrays(InFolder):
    def test_gaussians_round_trip(self):
        given = cloud()
        g = splat4d.Gaussians(**given)
        now = splat4d.Scene.from_arrays(**given).at(0.0)
        for name, array in given.items():
            np.testing.assert_allclose(getattr(g, name), array, atol=1e-6, err_msg=name)
            if name not in ("quats", "scales"):
                np.testing.assert_allclose(getattr(now, name), array, rtol=1e-4, atol=1e-5, err_msg=name)
        colors = np.full((40, 3), [0.1, 0.5, 0.9])
        dull = splat4d.Gaussians(*[given[k] for k in ("means", "quats", "scales", "opacities")], colors=colors)
        np.testing.assert_allclose(dull.sh[:, 0] * 0.28209479 + 0.5, colors, atol=1e-6)

    def test_a_pose_for_each_time_is_interpolated(self):
        given = cloud()
        paths = np.stack([given["means"], given["means"] + [1, 0, 0], given["means"] + [1, 2, 0]])
        scene = splat4d.Scene.from_arrays(**given | {"means": paths}, times=[0, 1, 3], fps=10)
        self.assertEqual((scene.clip, scene.fps), ((0.0, 3.0), 10.0))
        np.testing.assert_allclose(scene.at(2.0).means, given["means"] + [1, 1, 0], atol=1e-5)

    def test_kinematics_and_lifespans(self):
        given, n = cloud(), 40
        v = np.stack([np.full((n, 3), [1, 0, 0]), np.full((n, 3), [0, 0, 2.0])], axis=1)
        scene = splat4d.Scene.from_arrays(**given, velocities=v, centers=np.full(n, 0.5), durations=np.full(n, 0.25))
        self.assertEqual(scene.clip, (0.25, 0.75))
        now = scene.at(0.7)
        np.testing.assert_allclose(now.means, given["means"] + [0.2, 0, 0.08], atol=1e-5)
        np.testing.assert_allclose(now.opacities, given["opacities"] * np.exp(-0.5 * 0.8**2), rtol=1e-4)
        still = splat4d.Scene.from_arrays(**given, velocities=v[:, 0])
        np.testing.assert_allclose(still.at(0.25).means, given["means"] + [0.25, 0, 0], atol=1e-5)

    def test_frames_of_different_gaussians(self):
        frames = [splat4d.Gaussians(**cloud(n, n)) for n in (10, 30, 20)]
        scene = splat4d.Scene.from_frames(frames, fps=5, up=[0, -1, 0], background=[1, 1, 1])
        self.assertEqual([len(scene.at(k / 5)) for k in range(3)], [10, 30, 20])
        self.assertEqual((scene.up, scene.background, len(scene)), ([0, -1, 0], [1, 1, 1], 60))

    def test_invalid_arrays_are_named(self):
        wrong = {
            "means": (np.zeros((40, 2)), "means has the shape"),
            "quats": (np.zeros((40, 4)), "length 0"),
            "scales": (-np.ones((40, 3)), "not positive"),
            "opacities": (np.full(40, 2.0), "opacity 0 is 2"),
            "sh": (np.zeros((40, 5, 3)), "5 coefficients"),
        }
        for name, (array, text) in wrong.items():
            with self.assertRaisesRegex(splat4d.Error, text):
                splat4d.Scene.from_arrays(**cloud() | {name: array})
        holes = cloud()
        holes["means"][3, 1] = np.nan
        with self.assertRaisesRegex(splat4d.Error, "row 3 of means"):
            splat4d.Gaussians(**holes)
        with self.assertRaisesRegex(splat4d.Error, "exactly one of"):
            splat4d.Gaussians(**cloud(), colors=np.zeros((40, 3)))
        with self.assertRaisesRegex(splat4d.Error, "39 rows"):
            splat4d.Gaussians(**cloud() | {"opacities": np.full(39, 0.5)})
        with self.assertRaisesRegex(splat4d.Error, "cannot be combined"):
            splat4d.Scene.from_arrays(**cloud() | {"means": np.zeros((2, 40, 3))}, velocities=np.zeros((40, 3)))

    def test_files_edits_and_players_take_such_scenes(self):
        given = cloud()
        paths = np.stack([given["means"], given["means"] + [0.5, 0, 0]])
        scene = splat4d.Scene.from_arrays(**given | {"means": paths}, times=[0, 1])
        exact, played, still = (self.folder / n for n in ("own.safetensors", "own.s4d", "own.ply"))
        scene.export(exact)
        scene.bake(played)
        scene.export(still, 0.5)
        np.testing.assert_array_equal(splat4d.open(exact).at(0.5).means, scene.at(0.5).means)
        np.testing.assert_allclose(splat4d.open(still).at(0).means, scene.at(0.5).means, atol=1e-6)
        a, b = scene.render(CAMERA, 0.5), splat4d.open(played).render(CAMERA, 0.5)
        self.assertGreater(splat4d.metrics(b, a)["PSNR"], 30)
        half = scene.edit('version = 1\n[[edit]]\ndo = "crop"\nselect = "box(-9,-9,-9, 9,9,0)"\n')
        self.assertTrue(0 < len(half) < len(scene), len(half))
        objects = splat4d.command("info", exact)
        self.assertIn("scene", [o["type"] for o in objects])

    def test_times_outside_the_clip_warn(self):
        moving = splat4d.Scene.from_arrays(**cloud(), velocities=np.ones((40, 3)), clip=(0, 1))
        with self.assertWarnsRegex(UserWarning, "outside of the scene's clip"):
            moving.at(99)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            moving.at(1.0)
            splat4d.Scene.from_arrays(**cloud()).at(99)


class Gradients(InFolder):
    def test_gradients_equal_finite_differences(self):
        n = 3
        scene = splat4d.Scene.from_arrays(**cloud(n), velocities=np.full((n, 3), 0.3))
        # A smooth weight, so that what is cut off at faint edges counts for little.
        y, x, c = np.mgrid[:24, :32, :3]
        weights = np.cos(0.2 * x + 0.3 * y + c).astype(np.float32)
        loss = lambda scene, t=0.4: float((scene.render(CAMERA, t).astype(np.float64) * weights).sum())
        rendering = scene.render(CAMERA, 0.4, requires_grad=True)
        np.testing.assert_array_equal(rendering.color, scene.render(CAMERA, 0.4))
        grads, again = rendering.backward(weights), rendering.backward(weights)
        parameters = scene.parameters()
        self.assertEqual(set(grads) - set(parameters), {"time", "camera", "background"})
        for name, array in parameters.items():
            self.assertEqual(grads[name].shape, array.shape, name)
            np.testing.assert_array_equal(grads[name], again[name])
            direction = np.random.default_rng(3).normal(size=array.shape).astype(np.float32)
            h = 3e-4  # so small that no pixel falls in or out of a footprint
            sides = [loss(scene.with_parameters({name: array + s * h * direction})) for s in (1, -1)]
            measured, told = (sides[0] - sides[1]) / (2 * h), float((grads[name] * direction).sum())
            self.assertAlmostEqual(measured, told, delta=0.03 * max(abs(measured), 1), msg=name)
        measured = (loss(scene, 0.41) - loss(scene, 0.39)) / 0.02
        self.assertAlmostEqual(measured, grads["time"], delta=0.03 * abs(measured) + 0.05)
        opaque = scene.render(CAMERA, 0.4, requires_grad=True).backward(alpha=np.ones((24, 32)))
        self.assertTrue((opaque["layers.0.opacity_logits"] >= 0).all() and opaque["layers.0.opacity_logits"].max() > 0)

    def test_gradient_descent_fits_an_image(self):
        truth = splat4d.Scene.from_arrays(**cloud(20)).render(CAMERA, 0)
        scene = splat4d.Scene.from_arrays(**cloud(20) | {"sh": np.zeros((20, 1, 3))})
        value = lambda s: float(((s.render(CAMERA, 0) - truth) ** 2).mean())
        before = value(scene)
        for _ in range(30):
            r = scene.render(CAMERA, 0, requires_grad=True)
            d = r.backward(2 * (r.color - truth) / truth.size)
            sh = scene.parameters()["layers.0.sh"]
            scene = scene.with_parameters({"layers.0.sh": sh - 300 * d["layers.0.sh"]})
        self.assertLess(value(scene), 0.3 * before)

    def test_scenes_without_gradients_are_refused(self):
        scene = splat4d.Scene.from_arrays(**cloud())
        with self.assertRaisesRegex(splat4d.Error, "has no array"):
            scene.with_parameters({"means": np.zeros((40, 3))})
        with self.assertRaisesRegex(splat4d.Error, "shape"):
            scene.render(CAMERA, 0, requires_grad=True).backward(np.zeros((4, 4, 3)))
        with self.assertRaisesRegex(splat4d.Error, "depth has no gradients"):
            scene.render(CAMERA, 0, channel="depth", requires_grad=True)
        scene.bake(self.folder / "a.s4d")
        with self.assertRaisesRegex(splat4d.Error, "not its parameters"):
            splat4d.open(self.folder / "a.s4d").parameters()


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def drift(params, t):
    """Every Gaussian moves with a velocity of its own, and all with one wave that they share."""
    means = params["means"] + t * params["velocity"] + params["wave"] * np.sin(6 * t)
    return means, params["quats"], np.exp(params["log_scales"]), sigmoid(params["opacity_logits"])


def drift_backward(params, t, d_means, d_quats, d_scales, d_opacities, d_colors):
    o = sigmoid(params["opacity_logits"])
    return {
        "means": d_means,
        "quats": d_quats,
        "log_scales": d_scales * np.exp(params["log_scales"]),
        "opacity_logits": d_opacities * o * (1 - o),
        "velocity": t * d_means,
        "wave": np.sin(6 * t) * d_means.sum(axis=0),
    }


def own(**options):
    return splat4d.Motion(
        drift,
        backward=drift_backward,
        **dict(
            name="drift",
            per_gaussian={"velocity": 3},
            shared={"wave": np.zeros(3)},
            rates={"velocity": 0.02, "wave": (0.01, 0.001)},
        )
        | options,
    )


class Motions(InFolder):
    def train(self, out, motion, **settings):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return splat4d.train(KNIGHT, self.folder / out, motion=motion, progress=False, **BRIEF | settings)

    def test_a_motion_is_learnt_with_density_control_and_kept(self):
        settings = dict(motion=own(), iterations=60, densify__from=5, densify__interval=10)
        run = self.train("a", settings.pop("motion"), **settings)
        self.assertTrue(run.finished)
        scene = run.scene()
        learnt = scene.parameters()
        n = len(learnt["layers.0.means"])
        self.assertEqual(learnt["layers.0.velocity"].shape, (n, 3), "its rows follow the Gaussians")
        self.assertTrue(np.abs(learnt["layers.0.velocity"]).max() > 1e-3 and np.abs(learnt["layers.0.wave"]).max() > 1e-3)
        # Alive all the time, so that both times have all rows.
        ageless = scene.with_parameters({"layers.0.life_log_widths": np.full(n, 9.0, np.float32)})
        moved = np.abs(ageless.at(scene.clip[1]).means - ageless.at(scene.clip[0]).means)
        self.assertGreater(moved.max(), 1e-4)
        # The same again gives the same bits, stopped and resumed too.
        whole = self.scene_bytes(run)

        def stop(event):
            if event["type"] == "progress" and event["iteration"] >= 30:
                raise KeyboardInterrupt

        with self.assertRaises(KeyboardInterrupt), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            splat4d.train(KNIGHT, self.folder / "b", motion=own(), progress=stop, **BRIEF | settings)
        resumed = splat4d.resume(self.folder / "b", motion=own(), progress=False)
        self.assertEqual(self.scene_bytes(resumed), whole)
        # What plays needs no Python.
        scene.bake(self.folder / "a.s4d")
        camera = scene.cameras[0][1].downscaled(8)
        a, b = scene.render(camera, 0.05), splat4d.open(self.folder / "a.s4d").render(camera, 0.05)
        self.assertGreater(splat4d.metrics(b, a)["PSNR"], 30)

    def test_gradients_through_a_motion_equal_finite_differences(self):
        run = self.train("a", own(), iterations=4)
        scene = run.scene()
        camera = scene.cameras[0][1].downscaled(16)
        weights = np.random.default_rng(2).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
        loss = lambda s: float((s.render(camera, 0.05).astype(np.float64) * weights).sum())
        grads = scene.render(camera, 0.05, requires_grad=True).backward(weights)
        # Both move a Gaussian by about 3e-5.
        for name, h in (("layers.0.wave", 1e-4), ("layers.0.velocity", 6e-4)):
            array = scene.parameters()[name]
            errors, largest = [], 0.0
            for seed in range(3, 12):
                direction = np.random.default_rng(seed).normal(size=3).astype(np.float32)
                sides = [loss(scene.with_parameters({name: array + np.float32(s * h) * direction})) for s in (1, -1)]
                measured, told = (sides[0] - sides[1]) / (2 * h), float((grads[name] * direction).sum())
                errors.append(abs(measured - told))
                largest = max(largest, abs(told))
            # Where a pixel crosses the smallest alpha, the image jumps, and one difference measures the jump.
            self.assertLess(np.median(errors), 0.1 * largest, f"{name}: {errors} of {largest}")

    def test_errors_in_a_motion_are_raised_unchanged(self):
        def broken(params, t):
            raise RuntimeError("mine")

        with self.assertRaisesRegex(RuntimeError, "mine"):
            self.train("a", splat4d.Motion(broken, name="broken", backward=lambda *_: {}, warmup=0))
        short = lambda params, t: (params["means"][1:], *drift(params, t)[1:])
        with self.assertRaisesRegex(splat4d.Error, "means have the shape"):
            self.train("b", splat4d.Motion(
                short, name="short", backward=lambda *_: {}, warmup=0, per_gaussian={"velocity": 3}, shared={"wave": [0, 0, 0]}
            ))
        for motion in (own(name="spacetime"), own(name="a b"), own(per_gaussian={"means": 3}), own(rates={"speed": 1})):
            with self.assertRaises(splat4d.Error):
                self.train("c", motion)

    def test_a_run_can_be_replaced_and_the_error_explains_how(self):
        self.train("a", "spacetime", iterations=2)
        with self.assertRaisesRegex(splat4d.Error, r'splat4d\.resume\("[^"]+"\), replace it with force=True'):
            self.train("a", "spacetime", iterations=2)
        self.train("a", "still", iterations=2, force=True)


if __name__ == "__main__":
    unittest.main()
