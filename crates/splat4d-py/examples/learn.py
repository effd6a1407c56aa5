"""Trains a capture with progress, and measures held-out views."""
import sys

import splat4d


def progress(event):
    if event["type"] == "progress":
        print(f"step {event['iteration']}: {event['psnr']:.2f} dB, {event['gaussians']} Gaussians", end="\r")


run = splat4d.train(sys.argv[1], "learnt", iterations=200, downscale=4, progress=progress)
print("\nheld-out views:", run.evaluate()["PSNR"], "dB")
scene = run.scene()
scene.bake("learnt.s4d")
scene.export("learnt.html")  # player and scene as one page
