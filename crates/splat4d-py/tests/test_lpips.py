"""clients/lpips/convert.py on files as PyTorch writes them, without PyTorch."""
import io
import json
import pickle
import struct
import sys
import types
import zipfile
import unittest
from collections import OrderedDict
from unittest import mock

from common import ROOT, InFolder, module

SCRIPT = ROOT / "clients/lpips/convert.py"


def script():
    with mock.patch.object(sys, "dont_write_bytecode", True):
        return module(SCRIPT, "lpips_convert")


class Storage:
    def __init__(self, key, values):
        self.key, self.values = key, values


class Saved:
    """A tensor that pickles as PyTorch's do."""

    def __init__(self, key, shape, values):
        self.storage, self.shape = Storage(key, values), shape

    def __reduce__(self):
        steps = [1] * len(self.shape)
        for i in range(len(steps) - 1, 0, -1):
            steps[i - 1] = steps[i] * self.shape[i]
        return sys.modules["torch._utils"]._rebuild_tensor_v2, (self.storage, 0, self.shape, tuple(steps), False, OrderedDict())


def dump(state):
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")

    def rebuild(*_):
        raise AssertionError("the script must not import this")

    rebuild.__name__ = rebuild.__qualname__ = "_rebuild_tensor_v2"
    rebuild.__module__ = "torch._utils"
    utils._rebuild_tensor_v2 = rebuild
    kind = type("FloatStorage", (), {"__module__": "torch"})
    torch.FloatStorage, torch._utils = kind, utils

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if isinstance(value, Storage):
                return "storage", kind, value.key, "cpu", len(value.values)

    out = io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        Pickler(out, 2).dump(state)
    return out.getvalue()


def floats(values):
    return struct.pack(f"<{len(values)}f", *values)


class Converter(InFolder):
    def test_old_and_new_files_become_one_safetensors(self):
        convert = script()
        backbone = OrderedDict({"0.weight": Saved("a", (2, 3), [1, 2, 3, 4, 5, 6]), "0.bias": Saved("b", (2,), [7, 8])})
        data = b"".join(pickle.dumps(x, 2) for x in (convert.MAGIC, 1001, {"little_endian": True}))
        data += dump(backbone) + pickle.dumps(["a", "b"], 2)
        data += struct.pack("<q", 6) + floats([1, 2, 3, 4, 5, 6]) + struct.pack("<q", 2) + floats([7, 8])
        (self.folder / "net.pth").write_bytes(data)
        with zipfile.ZipFile(self.folder / "lin.pth", "w") as archive:
            linear = {"lin0.model.1.weight": Saved("0", (1, 2, 1, 1), [9, 10]), "classifier": Saved("1", (1,), [0])}
            archive.writestr("lin/data.pkl", dump(OrderedDict(linear)))
            archive.writestr("lin/data/0", floats([9, 10]))
            archive.writestr("lin/data/1", floats([0]))
        out = self.folder / "out.safetensors"
        convert.main([str(self.folder / "net.pth"), str(self.folder / "lin.pth"), str(out)])
        data = out.read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8:8 + length])
        self.assertEqual(sorted(header), ["features.0.bias", "features.0.weight", "lin0.model.1.weight"])
        begin, end = header["features.0.weight"]["data_offsets"]
        self.assertEqual(data[8 + length:][begin:end], floats([1, 2, 3, 4, 5, 6]))
        self.assertEqual(header["lin0.model.1.weight"]["shape"], [1, 2, 1, 1])

    def test_files_that_would_run_something_are_refused(self):
        convert = script()
        (self.folder / "bad.pth").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
        with self.assertRaisesRegex(SystemExit, "system"):
            convert.load(self.folder / "bad.pth")
        (self.folder / "text.pth").write_bytes(b"hello")
        with self.assertRaisesRegex(SystemExit, "not a file of PyTorch"):
            convert.load(self.folder / "text.pth")


if __name__ == "__main__":
    unittest.main()
