"""A motion model in PyTorch: a small deformation network (Yang et al. 2024, "Deformable 3D Gaussians"), trained by splat4d.

    python torch_motion.py CAPTURE [OUT] [STEPS]

The network gets a position and a time, both as sines and cosines of several frequencies, and returns an offset of the
position, of the quaternion and of the logarithms of the scales. splat4d trains it together with the Gaussians, which are
added and removed as usual.
"""

import pathlib
import sys
import tempfile

import torch

import splat4d

WIDTH, LAYERS = 128, 2
POSITION_FREQUENCIES, TIME_FREQUENCIES = 4, 3
# The network sees its input as numbers of about -1 to 1.
CLIP_SECONDS = 1.0


def encode(x, frequencies):
    """x, and sines and cosines of its multiples by powers of two (Mildenhall et al. 2020)."""
    scaled = torch.cat([x * 2**k for k in range(frequencies)], dim=-1)
    return torch.cat([x, scaled.sin(), scaled.cos()], dim=-1)


class Deformation(torch.nn.Module):
    """Canonical Gaussians and a time to Gaussians at that time."""

    def __init__(self, extent):
        super().__init__()
        self.extent = extent
        inputs = 3 * (1 + 2 * POSITION_FREQUENCIES) + 1 + 2 * TIME_FREQUENCIES
        sizes = [inputs] + [WIDTH] * LAYERS
        self.hidden = torch.nn.ModuleList(torch.nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.head = torch.nn.Linear(WIDTH, 10)
        # At first nothing moves.
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)

    def forward(self, params, t):
        # The network follows positions; positions do not follow the network (as the published code).
        places = params["means"].detach() / self.extent
        times = (t / CLIP_SECONDS).expand(len(places), 1)
        x = torch.cat([encode(places, POSITION_FREQUENCIES), encode(times, TIME_FREQUENCIES)], dim=-1)
        for layer in self.hidden:
            x = torch.relu(layer(x))
        offset, turn, stretch = self.head(x).split([3, 4, 3], dim=-1)
        means = params["means"] + self.extent * offset
        quats = torch.nn.functional.normalize(params["quats"], dim=-1) + turn
        scales = (params["log_scales"] + stretch).exp()
        return means, quats, scales, params["opacity_logits"].sigmoid()


def main():
    capture = sys.argv[1]
    out = pathlib.Path(sys.argv[2] if len(sys.argv) > 2 else tempfile.mkdtemp()) / "run"
    steps = int(sys.argv[3]) if len(sys.argv) > 3 else 1000
    torch.manual_seed(0)
    torch.set_num_threads(1)
    extent = 4.0  # about the size of the scene, scene units
    motion = splat4d.Motion.of_module(Deformation(extent), name="torch-deform", rate=(2e-3, 1e-4))
    run = splat4d.train(capture, out, motion=motion, iterations=steps, downscale=4, force=True)
    print({name: round(value, 3) for name, value in run.evaluate().items() if isinstance(value, float)})
    scene = run.scene()
    scene.bake(out / "scene.s4d")
    print(f"{out / 'scene.s4d'} plays without Python")


if __name__ == "__main__":
    main()
