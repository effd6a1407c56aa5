"""The training of a folder of `studies bench --device gpu --beside FOLDER` in gsplat, on one NVIDIA card.

    python with_gsplat.py FOLDER/A [FOLDER/B ...]

Needs PyTorch for CUDA, gsplat 1.5.3 (whose sources are compiled at the first import) and, for its fused SSIM, fused-ssim. Writes
gsplat.json next to scene.json: milliseconds a step by the wall and by CUDA events, and the loss of every step. The next
`studies bench --beside` tells how the two compare, if their losses agree.

Same Gaussians, cameras, pictures, order, loss, rates and Adam as splat4d's; one picture a step; nothing is born and nothing dies.
"""

import json
import math
import pathlib
import statistics
import sys
import time


def fused_ssim_of():
    """SSIM of two pictures [1, 3, h, w] with zero padding, as 3DGS has it, by fused-ssim."""
    from fused_ssim import fused_ssim

    return lambda drawn, truth: fused_ssim(drawn, truth, padding="same")


def train(folder: pathlib.Path) -> dict:
    import numpy
    import torch
    from gsplat import rasterization

    scene = json.loads((folder / "scene.json").read_text())
    device = torch.device("cuda")

    def load(name):
        return torch.from_numpy(numpy.load(folder / f"{name}.npy")).to(device)

    sh = load("sh")
    degree = math.isqrt(sh.shape[1]) - 1
    parameters = {
        "means": load("means"),
        "quats": load("quats"),
        "scales": load("log_scales"),
        "opacities": load("opacity_logits")[:, 0],
        "sh0": sh[:, :1].contiguous(),
        "shN": sh[:, 1:].contiguous(),
    }
    parameters = {name: torch.nn.Parameter(p) for name, p in parameters.items()}
    adam = scene["adam"]
    groups = [{"params": [p], "lr": scene["rates"][name], "name": name} for name, p in parameters.items()]
    optimiser = torch.optim.Adam(groups, betas=tuple(adam["betas"]), eps=adam["eps"], fused=True)
    views = scene["views"]
    cameras = torch.tensor([v["world_to_camera"] for v in views], device=device)
    intrinsics = torch.tensor([v["k"] for v in views], device=device)
    truths = [load(f"truth_{i}") for i in range(len(views))]
    background = torch.tensor([scene["background"]], device=device)
    ssim, share = fused_ssim_of(), scene["dssim"]
    losses = []

    def step(view):
        drawn, _, _ = rasterization(
            parameters["means"],
            parameters["quats"],
            torch.exp(parameters["scales"]),
            torch.sigmoid(parameters["opacities"]),
            torch.cat([parameters["sh0"], parameters["shN"]], dim=1),
            cameras[view : view + 1],
            intrinsics[view : view + 1],
            scene["width"],
            scene["height"],
            near_plane=views[view]["near"],
            eps2d=scene["low_pass"],
            sh_degree=degree,
            packed=False,
            backgrounds=background,
        )
        truth = truths[view]
        l1 = (drawn[0] - truth).abs().mean()
        dssim = 1.0 - ssim(drawn.permute(0, 3, 1, 2), truth.permute(2, 0, 1)[None])
        loss = (1.0 - share) * l1 + share * dssim
        loss.backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        losses.append(loss.detach())

    order, warm_up = scene["order"], scene["warm_up"]
    for view in order[:warm_up]:
        step(view)
    torch.cuda.synchronize()
    events = [torch.cuda.Event(enable_timing=True) for _ in range(len(order) - warm_up + 1)]
    clock = time.perf_counter()
    events[0].record()
    for event, view in zip(events[1:], order[warm_up:]):
        step(view)
        event.record()
    torch.cuda.synchronize()
    ms = 1e3 * (time.perf_counter() - clock) / (len(order) - warm_up)
    each = sorted(a.elapsed_time(b) for a, b in zip(events, events[1:]))
    tenth = len(each) // 10
    return {
        "program": "gsplat",
        "device": torch.cuda.get_device_name(),
        "ms": ms,
        "event_ms": {"median": statistics.median(each), "p10": each[tenth], "p90": each[-1 - tenth]},
        "losses": torch.stack(losses).tolist(),
    }


def main(folders):
    if not folders:
        sys.exit(__doc__)
    for folder in map(pathlib.Path, folders):
        ran = train(folder)
        (folder / "gsplat.json").write_text(json.dumps(ran, indent=1))
        print(f"{folder}: {ran['ms']:.3f} ms a step; losses at 1, 10, 100: {[ran['losses'][i - 1] for i in (1, 10, 100)]}")


if __name__ == "__main__":
    main(sys.argv[1:])
