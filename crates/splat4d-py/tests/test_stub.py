"""The types of `_native.pyi` are those of the extension module, by mypy's stubtest; skipped where mypy is not installed."""

import importlib.util
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

# PyO3 shows `...` for defaults that are no literals; the stub states their values.
ACCEPTED = ["has a default value of Ellipsis", "splat4d._native.__all__ is not present in stub"]
# Optional packages, imported inside of functions.
CONFIG = "[mypy]\n[mypy-torch.*,IPython.*]\nignore_missing_imports = true\n"


class Stub(unittest.TestCase):
    @unittest.skipUnless(importlib.util.find_spec("mypy"), "needs mypy")
    def test_the_stub_matches_the_module(self) -> None:
        package = Path(importlib.util.find_spec("splat4d").origin).parent
        with tempfile.TemporaryDirectory() as folder:
            config = Path(folder, "mypy.ini")
            config.write_text(CONFIG)
            done = subprocess.run(
                [sys.executable, "-m", "mypy.stubtest", "splat4d", "--concise", "--mypy-config-file", str(config)],
                env={**os.environ, "MYPYPATH": str(package.parent) if package.parent.name != "site-packages" else ""},
                cwd=folder,
                capture_output=True,
                text=True,
            )
        lines = done.stdout.splitlines() + done.stderr.splitlines()
        found = [line for line in lines if line.startswith("splat4d") and not any(a in line for a in ACCEPTED)]
        self.assertEqual(found, [], "the stub differs from the module")
        # Without a comparison there is no such line.
        self.assertTrue(any("is not present in stub" in line for line in lines), done.stdout + done.stderr)


if __name__ == "__main__":
    unittest.main()
