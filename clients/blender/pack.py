"""Packs the Blender add-on: `python clients/blender/pack.py splat4d-blender.zip`, then "Install from Disk" in Blender's preferences."""

import pathlib
import sys
import zipfile

HERE = pathlib.Path(__file__).resolve().parent
FILES = [HERE / "__init__.py", HERE / "blender_manifest.toml", HERE.parent / "python/s4d.py"]


def pack(out):
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in FILES:
            # A fixed time: the same files give the same archive.
            archive.writestr(zipfile.ZipInfo(path.name, (2026, 1, 1, 0, 0, 0)), path.read_bytes())


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    pack(sys.argv[1])
