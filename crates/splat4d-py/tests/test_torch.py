"""Losses of PyTorch, where it is installed: its gradients are the library's, and runs take them."""

import unittest

import numpy as np

import splat4d
from common import KNIGHT, SHORT, InFolder

try:
    import torch
except ImportError:
    torch = None

# Of the largest gradient: both compute in float32.
ALIKE = 1e-5


def ssim(a, b):
    """Mean SSIM of pictures [h, w, 3] as the 3DGS papers compute it: window of 11, σ 1.5, zero padding (CONVENTIONS.md)."""
    taps = torch.exp(-((torch.arange(11, dtype=a.dtype) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps)[None, None].repeat(3, 1, 1, 1) / taps.sum() ** 2
    blur = lambda x: torch.nn.functional.conv2d(x.permute(2, 0, 1)[None], window, padding=5, groups=3)
    ma, mb, aa, bb, ab = blur(a), blur(b), blur(a * a), blur(b * b), blur(a * b)
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * ma * mb + c1) * (2 * (ab - ma * mb) + c2)
    return (top / ((ma * ma + mb * mb + c1) * (aa - ma * ma + bb - mb * mb + c2))).mean()


def photometric(picture, truth, share):
    """(1 − share)·L1 + share·(1 − SSIM) and its gradient, by PyTorch in float64."""
    picture = torch.from_numpy(picture).double().requires_grad_()
    truth = torch.from_numpy(truth).double()
    value = (1 - share) * torch.nn.functional.l1_loss(picture, truth) + share * (1 - ssim(picture, truth))
    value.backward()
    return value.item(), picture.grad.numpy()


@unittest.skipUnless(torch, "PyTorch is not installed")
class Torch(InFolder):
    def agree(self, picture, truth, share):
        (theirs, d), (ours, e) = photometric(picture, truth, share), splat4d.photometric(picture, truth, share)
        self.assertAlmostEqual(theirs, ours, delta=ALIKE * abs(theirs))
        self.assertLess(np.abs(d - e).max(), ALIKE * np.abs(d).max())
        self.assertGreater(np.abs(d).max(), 0)

    def test_gradients_are_those_of_training(self):
        random = np.random.default_rng(1)
        truth = random.random((37, 53, 3), np.float32)
        picture = (0.8 * truth + 0.2 * random.random(truth.shape, np.float32)).astype(np.float32)
        for share in (0.0, 0.2, 1.0):
            self.agree(picture, truth, share)

    def test_renders_of_a_run_are_tensors_without_a_copy(self):
        steps = []

        def loss(picture, truth, view):
            tensor = torch.from_numpy(picture)
            self.assertEqual(tensor.data_ptr(), picture.ctypes.data)
            self.agree(picture, truth, 0.0)
            value, gradient = photometric(picture, truth, 0.0)
            steps.append(view.iteration)
            return value, gradient.astype(np.float32)

        self.assertTrue(splat4d.train(KNIGHT, self.folder / "torch", loss=loss, **SHORT).finished)
        self.assertEqual(sorted(set(steps)), list(range(SHORT["iterations"])))

    def test_tensors_are_accepted_as_images(self):
        picture = torch.rand(30, 40, 3)
        self.assertEqual(splat4d.metrics(picture, 0.9 * picture), splat4d.metrics(picture.numpy(), 0.9 * picture.numpy()))
        camera = splat4d.Camera(40, 30, 50.0)
        capture = splat4d.Capture.from_arrays([[picture]], [camera])
        np.testing.assert_allclose(capture.image(0), picture.numpy(), atol=1e-5)
        with self.assertRaisesRegex(splat4d.Error, "requires grad") as caught:
            splat4d.metrics(picture.clone().requires_grad_(), picture)
        self.assertEqual(caught.exception.kind, "bad_input")

    def test_a_gradient_with_a_graph_is_refused(self):
        def loss(picture, truth, view):
            return 0.0, torch.from_numpy(picture).requires_grad_()

        with self.assertRaisesRegex(splat4d.Error, "requires grad"):
            splat4d.train(KNIGHT, self.folder / "graph", loss=loss, **SHORT)
