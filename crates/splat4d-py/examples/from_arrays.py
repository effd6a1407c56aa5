"""A capture of images in memory; here renders of a scene, but any images with cameras and times work."""
import sys

import numpy as np

import splat4d

scene = splat4d.open(sys.argv[1])
cameras = [camera.downscaled(4) for _, camera in scene.cameras[:6]]
times = np.linspace(*scene.clip, 4)
images = [[scene.render(camera, t).clip(0, 1) for t in times] for camera in cameras]
points = scene.at(times[0]).means[::10]
capture = splat4d.Capture.from_arrays(images, cameras, times, points, up=scene.up, hold_out=["cam05"])
run = splat4d.train(capture, "again", iterations=50)
print(capture, run.evaluate()["PSNR"])
