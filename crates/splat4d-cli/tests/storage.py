"""Object storage: workers of `splat4d` on a local server with the interface of S3 (moto).

SPLAT4D: the command, built with the feature `storage`. Needs moto[s3,server].
"""

import json
import os
import signal
import subprocess
import tempfile
import time
import unittest
from pathlib import Path

import boto3
from moto.server import ThreadedMotoServer

KNIGHT = Path(__file__).resolve().parents[3] / "examples/knight"
COMMAND = os.environ["SPLAT4D"]
CAMERAS, FRAMES = 5, 14
TRAIN = [
    "--chunk-frames", "6", "--overlap", "2", "--motion", "spacetime", "--downscale", "8", "--hold-out", "none",
    "--set", "init.source=random", "--set", "init.count=80", "--set", "max_cap=150", "--set", "checkpoint_interval=10",
    "--set", "sh_degree=0",
]
FILES = ["scene.safetensors", "scene.s4d", "chunks/00/scene.safetensors", "chunks/01/scene.safetensors"]


def small_capture(folder):
    """A few cameras and frames of the bundled capture."""
    capture = json.loads((KNIGHT / "capture.json").read_text())
    capture.pop("points", None)
    capture.pop("hold_out", None)
    capture["cameras"] = capture["cameras"][:CAMERAS]
    for camera in capture["cameras"]:
        camera["frames"] = FRAMES
        for key in ("masks", "depth", "labels", "flow"):
            camera.pop(key, None)
        name = camera["images"]
        for frame in range(FRAMES):
            file = name % (frame + camera.get("start", capture.get("start", 0)))
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes((KNIGHT / file).read_bytes())
    for key in ("labels", "sound"):
        capture.pop(key, None)
    (folder / "capture.json").write_text(json.dumps({**capture, "frames": FRAMES}))


class Storage(unittest.TestCase):
    def setUp(self):
        self.work = Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        self.server.start()
        self.addCleanup(self.server.stop)
        host, port = self.server.get_host_and_port()
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("AWS_")},
            "AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{host}:{port}", "NO_PROXY": "127.0.0.1", "no_proxy": "127.0.0.1",
        }
        self.s3 = boto3.client(
            "s3", endpoint_url=f"http://{host}:{port}", region_name="us-east-1", aws_access_key_id="testing",
            aws_secret_access_key="testing",
        )
        self.bucket = f"takes-{time.time_ns()}"
        self.s3.create_bucket(Bucket=self.bucket)
        self.capture = self.work / "capture"
        small_capture(self.capture)
        for file in self.capture.rglob("*"):
            if file.is_file():
                self.s3.upload_file(str(file), self.bucket, f"day/capture/{file.relative_to(self.capture)}")

    def address(self, name):
        return f"s3://{self.bucket}/{name}"

    def begin(self, *words, worker="worker"):
        # A local folder per worker, as on machines of their own.
        words = [COMMAND, *map(str, words), "--local", self.work / worker]
        return subprocess.Popen(words, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def run_it(self, *words, code=0, **options):
        process = self.begin(*words, **options)
        out, err = process.communicate(timeout=300)
        self.assertEqual(process.returncode, code, f"{words}\n{out}\n{err}")
        return out + err

    def train(self, part, steps=20):
        words = ["train", self.address("day/capture"), "-o", self.address("run"), *TRAIN]
        return [*words, "--set", f"iterations={steps}", "--chunk", part]

    def object(self, name):
        return self.s3.get_object(Bucket=self.bucket, Key=f"run/{name}")["Body"].read()

    def keys(self, prefix=""):
        pages = self.s3.get_paginator("list_objects_v2").paginate(Bucket=self.bucket, Prefix=f"run/{prefix}")
        return [entry["Key"] for page in pages for entry in page.get("Contents", [])]

    def shared_folder(self, steps=20):
        """The files of the same run in one folder."""
        run = self.work / "folder"
        words = ["train", self.capture, "-o", run, *TRAIN, "--set", f"iterations={steps}"]
        subprocess.run([COMMAND, *map(str, words), "--chunk", "all"], check=True, capture_output=True)
        subprocess.run([COMMAND, "join", str(run), "--no-eval"], check=True, capture_output=True)
        return {file: (run / file).read_bytes() for file in FILES}

    def check_same(self, expected):
        self.run_it("join", self.address("run"), "--no-eval", worker="joiner")
        for file, data in expected.items():
            self.assertTrue(self.object(file) == data, f"{file} differs from that of a shared folder")
        self.assertEqual(self.keys(".splat4d/"), [], "all claims are given back")

    def test_two_workers_make_the_bits_of_a_shared_folder(self):
        expected = self.shared_folder()
        self.assertIn("--chunk shared", self.run_it(*self.train("0"), code=2))
        both = [self.begin(*self.train("all"), worker=f"worker{n}") for n in range(2)]
        for process in both:
            out, err = process.communicate(timeout=600)
            self.assertEqual(process.returncode, 0, out + err)
        self.assertIn("chunk", self.run_it("status", self.address("run")))
        self.check_same(expected)
        status = json.loads(self.run_it("status", self.address("run"), "--json").splitlines()[-1])
        self.assertTrue(status["finished"] and status["run"] == self.address("run"), status)
        self.assertIn("finished", self.run_it("info", self.address("run")))
        self.assertIn(f"{CAMERAS} fixed", self.run_it("info", self.address("day/capture")))
        self.assertIn(self.address("day/capture"), self.object("run.json").decode())

    def test_a_killed_worker_is_replaced(self):
        steps = 400
        expected = self.shared_folder(steps)
        first = self.begin(*self.train("shared", steps), worker="first")
        deadline = time.monotonic() + 120
        while not self.keys(".splat4d/claims/shared") and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(1)
        first.send_signal(signal.SIGKILL)
        first.communicate()
        refused = self.run_it(*self.train("shared", steps), code=1, worker="second")
        self.assertIn("in use by", refused)
        # The claim of a worker without a heartbeat for 60 s is taken over.
        self.run_it(*self.train("all", steps), worker="second")
        self.check_same(expected)

    def test_errors_name_the_remedy(self):
        status = ["status", self.address("run")]
        self.assertIn("no such run", self.run_it(*status, code=2))
        self.assertIn("no such bucket", self.run_it("status", f"s3://no-{self.bucket}/run", code=2))
        self.assertIn("--chunk", self.run_it("train", self.address("day/capture"), "-o", self.address("run"), code=2))
        self.assertIn("--resume", self.run_it("train", "--resume", self.address("run"), code=2))
        kept = dict(self.environment)
        del self.environment["AWS_SECRET_ACCESS_KEY"]
        self.assertIn("AWS_SECRET_ACCESS_KEY", self.run_it(*status, code=2))
        self.environment = {**kept, "AWS_ENDPOINT_URL": "storage"}
        self.assertIn("AWS_ENDPOINT_URL", self.run_it(*status, code=2))
        self.environment = kept
        # Gone in the middle.
        process = self.begin(*self.train("shared", 100_000))
        while not self.keys(".splat4d/claims/shared"):
            time.sleep(0.05)
        self.server.stop()
        out, err = process.communicate(timeout=300)
        self.assertEqual(process.returncode, 1, out + err)
        self.assertRegex(err, "does not answer|out of reach")
        self.assertIn("the same command again", err)

    def test_names_that_lead_elsewhere_are_refused(self):
        self.s3.put_object(Bucket=self.bucket, Key="day/capture/../../escaped", Body=b"x")
        said = self.run_it(*self.train("shared"), code=2)
        self.assertIn("is not the name of a file in a folder", said)
        self.assertEqual(list(self.work.rglob("escaped")), [])


if __name__ == "__main__":
    unittest.main()
