#!/usr/bin/env python3
"""Makes a capture.json for splat4d from a rig's calibration and frames.

The calibration is a JSON file {"fps": 60, "cameras": [{"name", "width", "height", "fx", "fy", "cx", "cy",
"world_to_camera"}, ...]} with OpenCV axes (x right, y down, z forward) and row-major 4x4 poses. Frames lie in
OUTPUT/images/NAME/000000.jpg and so on. If they do not exist yet, the script prints the ffmpeg commands that extract them
from VIDEOS/NAME.mp4: run them, then run this script again.

    rig_from_calibration.py cameras.json OUTPUT --videos videos/

Needs only Python.
"""

import argparse
import json
import os
import shlex
import sys

KEYS = ("name", "width", "height", "fx", "fy", "cx", "cy", "world_to_camera")
# Optional keys that a calibration may have and capture.json understands as they are.
OPTIONAL = ("distortion", "time_offset")
ENDINGS = (".jpg", ".jpeg", ".png", ".webp")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", help="JSON file with fps and cameras")
    parser.add_argument("output", help="folder of the capture; its images/ holds or will hold the frames")
    parser.add_argument("--videos", default="videos", help="folder of NAME.mp4, for the printed commands")
    parser.add_argument("--hold-out", metavar="NAMES", help="cameras to measure on, separated by commas")
    parser.add_argument("--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help="upwards in the world")
    arguments = parser.parse_args()

    with open(arguments.calibration) as file:
        calibration = json.load(file)
    cameras, commands = [], []
    for given in calibration["cameras"]:
        missing = [key for key in KEYS if key not in given]
        if missing:
            sys.exit(f"{arguments.calibration}: camera {given.get('name', '?')} lacks {', '.join(missing)}")
        name = given["name"]
        folder = os.path.join(arguments.output, "images", name)
        frames = sorted(f for f in os.listdir(folder) if f.lower().endswith(ENDINGS)) if os.path.isdir(folder) else []
        if not frames:
            commands.append(extraction(arguments, given, folder))
            continue
        camera = {key: given[key] for key in KEYS + OPTIONAL if key in given}
        camera["images"] = [f"images/{name}/{frame}" for frame in frames]
        cameras.append(camera)
    if commands:
        print("These cameras have no frames yet. Run:\n", *commands, "\nand then this script again.", sep="\n")
        sys.exit(1)

    # Cameras that started or stopped late would leave times that only some of them recorded.
    count = min(len(camera["images"]) for camera in cameras)
    for camera in cameras:
        del camera["images"][count:]
    capture = {"version": 1, "axes": "opencv", "fps": calibration.get("fps", 30), "cameras": cameras}
    if arguments.up:
        capture["up"] = arguments.up
    if arguments.hold_out:
        capture["hold_out"] = {"cameras": arguments.hold_out.split(",")}
    path = os.path.join(arguments.output, "capture.json")
    with open(path + ".part", "w") as file:
        json.dump(capture, file, indent=1)
    os.replace(path + ".part", path)
    print(f"{path}: {len(cameras)} cameras, {count} frames each, {capture['fps']} frames per second")


def extraction(arguments, camera, folder):
    """The command that extracts one camera's frames at the size of its calibration."""
    video = os.path.join(arguments.videos, camera["name"] + ".mp4")
    scale = f"scale={camera['width']}:{camera['height']}:flags=area"
    frames = os.path.join(folder, "%06d.jpg")
    return (
        f"mkdir -p {shlex.quote(folder)} && ffmpeg -v error -i {shlex.quote(video)} "
        f"-vf {scale} -start_number 0 -fps_mode passthrough -qscale:v 2 {shlex.quote(frames)}"
    )


if __name__ == "__main__":
    main()
